"""Faults of microphones and of the stream."""
