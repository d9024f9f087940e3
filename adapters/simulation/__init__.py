"""A blind junction in the computer: recordings with known truth."""
