"""Theoretical limits of an array, the accuracy of the estimators, and their cost."""
