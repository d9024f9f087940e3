"""Continuous streams of any length: traffic as arrivals, sound block by block, truth per vehicle."""
