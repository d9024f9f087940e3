"""Studies on real recordings of a corner."""
