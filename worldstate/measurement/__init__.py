"""What an adapter hands to the filter, and the roles that a modality can play."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
