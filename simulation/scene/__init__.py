"""Geometry and motion: junctions, occluders, vehicles, presets."""
