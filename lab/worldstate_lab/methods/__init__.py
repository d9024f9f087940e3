"""The rows of Table I and beyond, one file an idea."""
