"""The report of an evaluation: its contents as values, its figures, and how they become files."""
