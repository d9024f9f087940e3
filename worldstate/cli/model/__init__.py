"""Commands that make, fit, examine and show a model."""
