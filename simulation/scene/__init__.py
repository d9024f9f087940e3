"""Who stands and drives where: junctions, occluders, vehicles, presets."""
