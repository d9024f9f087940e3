"""Signature models: from a feature vector to log-likelihoods of the explanations."""
