"""Hazard awareness with a degraded camera."""
