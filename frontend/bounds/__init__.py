"""Cramer-Rao bounds of what the front-end estimates."""
