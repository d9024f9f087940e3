"""Signatures of single clips: what tells a vehicle from background, and where it stops doing so."""
