"""Arrays, models, checkpoints and tables in files."""
