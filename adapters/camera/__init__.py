"""Cameras, detectors, their detections and their miss rates."""
