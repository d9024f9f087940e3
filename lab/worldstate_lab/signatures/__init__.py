"""Signatures of single clips: separability of vehicles and background, and its limits."""
