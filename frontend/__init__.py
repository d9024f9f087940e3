"""Samples into numbers: arrays, spectra, bearing, approach rate, signatures and their bounds.

This folder knows no world: it imports nothing of the library but `errors`, `checks` and `values`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
