"""Ablations (section IX) and identifiability (section VI) of the paper."""
