"""Signature models: from a feature vector to log-likelihoods of the explanations."""

from .window_classes import ClassifierSignature

__all__ = ["ClassifierSignature"]
