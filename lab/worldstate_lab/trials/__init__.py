"""Recordings as trials for every method: found, processed once, cached by content, classified."""
