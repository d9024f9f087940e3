"""Explanations of evidence: hidden source, visible source, no source.

This folder turns evidence into a posterior and knows no audio: it serves any modality that has a signature
model and an expected co-evidence.
"""
