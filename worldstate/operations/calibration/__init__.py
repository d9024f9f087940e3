"""Thresholds and risk maps from hazard-free recordings."""
