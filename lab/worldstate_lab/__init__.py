"""The paper's evaluation and our own experiments; imported by nothing but their commands."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
