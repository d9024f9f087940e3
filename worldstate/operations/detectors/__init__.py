"""How often a camera's detector misses what is there."""
