"""The rows of Table I and further methods, one idea per file."""
