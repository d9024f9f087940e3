"""What several commands share: output, progress, options."""
