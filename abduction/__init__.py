"""Explanations of evidence: hidden source, visible source, no source.

This folder turns evidence into a posterior and knows no audio: it serves any modality that has a signature
model and an expected co-evidence.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
