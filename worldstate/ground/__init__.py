"""What every room may import, and what imports none of them: errors, checks, values, schemas."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
