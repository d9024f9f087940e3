"""Cramer-Rao bounds of the front-end's estimates."""
