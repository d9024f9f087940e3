"""Signature models: from a feature vector to log-likelihoods of the explanations."""

from .classifier_signature import ClassifierSignature

__all__ = ["ClassifierSignature"]
