"""Explanations of evidence: hidden source, visible source, no source.

This folder turns evidence into a posterior and knows no audio: any modality with a signature model and an
expected co-evidence can speak through it.
"""
