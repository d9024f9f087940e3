"""Commands that learn a street from the vehicles that pass."""
