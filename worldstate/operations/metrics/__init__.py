"""Figures of merit from labels and scores alone."""
