"""Arrays, models, checkpoints and tables on disk."""
