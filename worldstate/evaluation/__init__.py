"""Protocols and metrics that hold the library against data."""
