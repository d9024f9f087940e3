"""Motion of one entity at constant velocity, in modified polar and in Cartesian coordinates."""
