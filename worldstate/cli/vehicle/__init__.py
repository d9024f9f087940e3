"""Commands about the vehicle that carries the sensors."""
