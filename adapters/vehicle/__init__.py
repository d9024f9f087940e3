"""The vehicle that carries the sensors: their poses and clock offsets."""
