"""The hazard statistic over a recorded stream, with or without the parts that an ablation removes."""

from collections.abc import Sequence

import numpy as np

from worldstate.ground.checks import finite_array
from worldstate.ground.typing import FloatArray
from worldstate.operations.recordings.hop_table import ABSENT, PRESENT, HopTable

# An approach score above this many standard deviations is treated as equal to it.
LARGEST_SCORE = 3.0


def stream_statistic(
    stream: HopTable, reference_prior: Sequence[float], use_absence: bool = True, approach_weight: float = 0.0
) -> FloatArray:
    r"""Return eq. (6) at a fixed prior at every hop, shape (n,), in [0, 1].

    .. math:: \mathrm{logit}\, s = \log \frac{\sum_k \pi_k \ell_k}
              {\pi_{vis}\, p(V | vis)\, \ell_{vis} / p(V | hid) + \pi_0\, \ell_0}
              + w\, \frac{\rho}{\sigma_\rho}

    with the approach rate rho in standard deviations, clipped to three; hops without a usable rate are
    marginalised. Without the last term it is `abduction.posterior.statistic`. Without absence the result of
    the camera query is ignored: only the signature is used, beta = 1.

    Shapes: reference_prior (K + 2,).
    """
    joint = log_joint(stream, reference_prior, use_absence)
    hidden = np.logaddexp.reduce(joint[:, :-2], axis=1)
    log_odds = hidden - np.logaddexp(joint[:, -2], joint[:, -1])
    if approach_weight:
        score = np.clip(stream.approach, -LARGEST_SCORE, LARGEST_SCORE)
        log_odds += approach_weight * np.where(np.isfinite(stream.approach), score, 0.0)
    return np.asarray(np.exp(-np.logaddexp(0.0, -log_odds)))


def log_joint(stream: HopTable, reference_prior: Sequence[float], use_absence: bool) -> FloatArray:
    """Return the log of prior, signature and query result, up to a constant per hop, shape (n, K + 2)."""
    prior = finite_array("reference_prior", reference_prior, (stream.log_likelihoods.shape[1],))
    joint = np.log(prior) + stream.log_likelihoods
    if use_absence:
        # log p(V | visible) / p(V | hidden or none)
        beta, answer = stream.miss_rate, stream.answer
        # If nothing is present the clutter does not matter, and 1 keeps its logarithm finite.
        clutter = np.where(answer == PRESENT, stream.clutter_rate, 1.0)
        with np.errstate(divide="ignore"):
            present = np.log1p(-beta * (1.0 - clutter)) - np.log(clutter)
            joint[:, -2] += np.select([answer == ABSENT, answer == PRESENT], [np.log(beta), present], 0.0)
    return np.asarray(joint)
