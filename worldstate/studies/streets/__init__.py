"""Published figures on simulated streets, and how far these are from real ones."""
