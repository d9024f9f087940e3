"""Adapters: everything that touches a file, a camera, a data set, a bus or a clock."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
