"""Explanations of evidence: hidden source, visible source, no source.

This package combines priors, evidence and co-evidence into a posterior. It does not process audio, so any
modality with a signature model and an expected co-evidence can use it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
