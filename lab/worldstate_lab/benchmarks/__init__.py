"""Costs and accuracies of parts of the library, compared with peers."""
