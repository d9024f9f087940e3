"""Approach: looming, and the frequency of a tone."""
