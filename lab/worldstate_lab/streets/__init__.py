"""Simulated feature windows of junctions, and their distance to real ones."""
