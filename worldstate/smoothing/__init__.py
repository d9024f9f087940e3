"""Fixed-lag smoother over entities, which corrects past states beside the filter."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
