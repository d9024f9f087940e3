"""The acoustic front-end: arrays, spectra, bearing, approach rate, signatures and their bounds.

This package does not depend on the world-state. From the rest of the library it imports only `ground` (types,
errors, checks, values).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
