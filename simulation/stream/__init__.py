"""Continuous streams of any length: traffic as arrivals, sound in blocks, truth per vehicle."""
