"""Offset between a camera and an array in time and yaw, from vehicles that both detected."""
