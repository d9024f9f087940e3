"""Simulated recordings, their truth and their files."""
