"""Prediction from three seconds of window evidence: whether, when and on which side a vehicle appears."""
