"""Cameras, detectors, their detections, and how often they miss."""
