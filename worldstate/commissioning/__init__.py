"""Models for an array of one's own: streets simulated, listened to, learned from and examined."""
