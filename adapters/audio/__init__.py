"""Multichannel sound files."""
