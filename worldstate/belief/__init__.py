"""Beliefs: what is carried from one measurement to the next."""
