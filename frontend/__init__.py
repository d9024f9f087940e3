"""Samples into numbers: arrays, spectra, bearing, approach rate, signatures and their bounds.

This folder knows no world: it imports nothing of the library but `errors`, `checks` and `values`.
"""
