"""Approach: looming, engine line, Doppler shift."""
