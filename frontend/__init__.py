"""The acoustic front-end: arrays, spectra, bearing, approach rate, signatures and their bounds.

Nothing here depends on the world-state: the only imports from the rest of the library are those of its ground
floor (types, errors, checks, values).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
