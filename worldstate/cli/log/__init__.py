"""Commands that read what was logged."""
