"""Figures of merit that need nothing but labels and scores."""
