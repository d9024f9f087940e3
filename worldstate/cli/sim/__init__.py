"""Commands that simulate streets."""
