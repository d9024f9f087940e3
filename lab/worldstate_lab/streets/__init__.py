"""Simulated feature windows of junctions, and how far they are from real ones."""
