"""Commands for users with recordings of their own."""
