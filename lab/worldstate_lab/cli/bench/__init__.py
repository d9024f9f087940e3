"""Costs and accuracies of parts of the library, beside peers."""
