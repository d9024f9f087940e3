"""Sensors as they run: microphones, cameras and detectors of one's own, and the time that all of it takes."""
