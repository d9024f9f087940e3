"""The vehicle that carries the sensors: where they are, and how their clocks differ."""
