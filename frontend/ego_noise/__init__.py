"""Noise of the own vehicle: learned, whitened, cancelled."""
