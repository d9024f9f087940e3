"""The signature models that a file may hold, told apart by their kind."""

from .ensemble import EnsembleModel
from .published_signature import SignatureModel

AnySignature = SignatureModel | EnsembleModel
