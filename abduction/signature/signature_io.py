"""Signature models on file, distinguished by their kind."""

from collections.abc import Mapping

from .ensemble import KIND, EnsembleModel
from .published_signature import SignatureModel

AnySignature = SignatureModel | EnsembleModel


def signature_from_dict(data: object) -> AnySignature:
    """Return the model that a `to_dict` wrote: an ensemble where it says so, else the published classifier.

    Examples
    --------
    >>> signature_from_dict({"kind": "ensemble"})
    Traceback (most recent call last):
        ...
    worldstate...InvalidArgumentError: signature: expected an object of classes front, left, none, right
    """
    if isinstance(data, Mapping) and data.get("kind") == KIND:
        return EnsembleModel.from_dict(data)
    return SignatureModel.from_dict(data)
