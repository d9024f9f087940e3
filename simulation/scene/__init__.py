"""Places and motion: junctions, occluders, vehicles, presets."""
