"""What a signature model says of a simulated recording whose features were kept.

Kept is what the front-end measured, not what a classifier made of it, so that another classifier reads the
same files.
"""

from collections.abc import Mapping

import numpy as np

from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.signature_io import AnySignature
from worldstate.abduction.signature.site_signature import SiteSignature
from worldstate.ground.typing import AnyArray, FloatArray
from worldstate.operations.recordings.hop_table import HopTable
from worldstate.operations.recordings.stream_statistic import stream_statistic

# Hidden left and hidden right among the explanations.
DIRECTION_COLUMNS = slice(0, 2)


def classified(recording: HopTable, signature: AnySignature) -> HopTable:
    """Add what a classifier, which may learn its site anew, says of the features at its own prior."""
    model = SiteSignature(signature) if isinstance(signature, EnsembleModel) else signature
    evidence = np.stack([model.evidence(feature).log_likelihoods for feature in recording.features])
    stream = recording.replace(log_likelihoods=evidence)
    joint = evidence + np.log(signature.reference_prior)
    posteriors = np.exp(joint - np.logaddexp.reduce(joint, axis=1, keepdims=True))
    return recording.replace(**decisions(posteriors, stream_statistic(stream, signature.reference_prior)))


def decisions(posteriors: FloatArray, statistic: FloatArray) -> Mapping[str, AnyArray]:
    """Return what the rules read: eq. (6), the paper's P_left + P_right, and whether the argmax is a side.

    Shapes: posteriors (n, 4) of hidden left, hidden right, visible and none, statistic (n,).
    """
    return {
        "statistic": statistic,
        "published_statistic": posteriors[:, DIRECTION_COLUMNS].sum(axis=1),
        "argmax_is_side": posteriors.argmax(axis=1) < DIRECTION_COLUMNS.stop,
    }
