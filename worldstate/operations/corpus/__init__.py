"""Many recordings: heard over processes or machines, kept as Parquet, counted."""
