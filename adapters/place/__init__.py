"""A place behind the corner: where on the crossing street a sound comes from, for known walls and array."""
