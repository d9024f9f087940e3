"""Commands that reproduce the paper's evaluation."""
