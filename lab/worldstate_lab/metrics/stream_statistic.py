"""The hazard statistic over a recorded stream, with switches for the parts that an ablation removes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.typing import FloatArray
from worldstate.operations.recordings.hop_table import ABSENT, PRESENT, HopTable

# An approach score above this many standard deviations is treated as equal to it.
LARGEST_SCORE = 3.0


@dataclass(frozen=True, slots=True)
class StatisticSwitches:
    """Parts of eq. (6) that the statistic uses."""

    # False ignores the result of the camera query: only the signature is used, beta = 1.
    use_absence: bool = True
    # Increase of the log-odds, in nats, per standard deviation of the approach rate above zero. Hops without
    # a usable rate are marginalised.
    approach_weight: float = 0.0

    def __post_init__(self) -> None:
        in_range("approach_weight", self.approach_weight, 0.0, 100.0)


def stream_statistic(
    stream: HopTable, reference_prior: Sequence[float], switches: StatisticSwitches | None = None
) -> FloatArray:
    r"""Return eq. (6) at a fixed prior at every hop, shape (n,), in [0, 1].

    .. math:: \mathrm{logit}\, s = \log \frac{\sum_k \pi_k \ell_k}
              {\pi_{vis}\, p(V | vis)\, \ell_{vis} / p(V | hid) + \pi_0\, \ell_0}
              + w\, \frac{\rho}{\sigma_\rho}

    with the approach rate rho in standard deviations, clipped to three. Without the last term it is
    `abduction.posterior.statistic`.

    Shapes: reference_prior (K + 2,).
    """
    chosen = switches or StatisticSwitches()
    joint = log_joint(stream, reference_prior, chosen)
    hidden = np.logaddexp.reduce(joint[:, :-2], axis=1)
    log_odds = hidden - np.logaddexp(joint[:, -2], joint[:, -1])
    if chosen.approach_weight:
        log_odds += chosen.approach_weight * approach_score(stream)
    return np.asarray(np.exp(-np.logaddexp(0.0, -log_odds)))


def approach_score(stream: HopTable) -> FloatArray:
    """Return the approach rate in standard deviations, clipped to three, 0 if not usable, shape (n,)."""
    usable = np.isfinite(stream.approach)
    return np.where(usable, np.clip(stream.approach, -LARGEST_SCORE, LARGEST_SCORE), 0.0)


def log_joint(stream: HopTable, reference_prior: Sequence[float], switches: StatisticSwitches) -> FloatArray:
    """Return the log of prior, signature and query result, up to a constant per hop, shape (n, K + 2)."""
    prior = finite_array("reference_prior", reference_prior, (stream.log_likelihoods.shape[1],))
    joint = np.log(prior) + stream.log_likelihoods
    with np.errstate(divide="ignore"):
        joint[:, -2] += _log_visible(stream, switches)
    return np.asarray(joint)


def _log_visible(stream: HopTable, switches: StatisticSwitches) -> FloatArray:
    """Return log p(V | visible) / p(V | hidden or none) at every hop."""
    if not switches.use_absence:
        return np.zeros(len(stream))
    beta, answer = stream.miss_rate, stream.answer
    # If nothing is present the clutter does not matter, and 1 keeps its logarithm finite.
    clutter = np.where(answer == PRESENT, stream.clutter_rate, 1.0)
    present = np.log1p(-beta * (1.0 - clutter)) - np.log(clutter)
    return np.select([answer == ABSENT, answer == PRESENT], [np.log(beta), present], 0.0)
