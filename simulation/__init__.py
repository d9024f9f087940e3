"""A blind junction that can be heard: scene, vehicle, propagation, background, camera, data set."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
