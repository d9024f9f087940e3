"""Thresholds and risk maps from recordings without hazards."""
