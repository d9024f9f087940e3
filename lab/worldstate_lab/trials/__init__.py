"""Recordings as every method is given them: found, heard once, kept by their content, classified."""
