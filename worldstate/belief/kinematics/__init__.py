"""Motion of one entity: modified polar and Cartesian coordinates with constant velocity."""
