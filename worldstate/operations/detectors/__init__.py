"""Measurement of the miss rates of a camera's detector."""
