"""The signature models that a file may hold, told apart by their kind."""

from numpy.typing import ArrayLike

from worldstate.ground.typing import FloatArray

from .ensemble import EnsembleModel
from .published_signature import SignatureModel

AnySignature = SignatureModel | EnsembleModel


def explain(signature: AnySignature, X: ArrayLike) -> FloatArray:
    """Return the posteriors of front, left, none and right of windows, shape (n, 4), by either model."""
    return signature.explain(X) if isinstance(signature, EnsembleModel) else signature.predict_proba(X)
