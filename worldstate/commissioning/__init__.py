"""Models for a user's own array: simulated streets, processed sound, training and exam."""
