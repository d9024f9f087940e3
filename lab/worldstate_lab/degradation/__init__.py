"""Hazard awareness while the camera fails."""
