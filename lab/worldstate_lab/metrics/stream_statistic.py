"""The hazard statistic over a recorded stream, with the parts of it that an ablation removes as switches."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.typing import FloatArray
from worldstate.operations.recordings.hop_table import ABSENT, PRESENT, HopTable

# An approach score beyond this many standard deviations says no more than one at it.
LARGEST_SCORE = 3.0


@dataclass(frozen=True, slots=True)
class StatisticSwitches:
    """What of eq. (6) the statistic uses."""

    # False drops the answer of the channel that was asked: the signature alone, beta = 1.
    use_absence: bool = True
    # Nats by which the log-odds rise with each standard deviation of the approach rate above zero; where it
    # is not usable it is marginalised.
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

    with the approach rate rho in standard deviations, held within three. Without the last term it is
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
    """Return the approach rate in standard deviations within three, 0 where it is not usable, shape (n,)."""
    usable = np.isfinite(stream.approach)
    return np.where(usable, np.clip(stream.approach, -LARGEST_SCORE, LARGEST_SCORE), 0.0)


def log_joint(stream: HopTable, reference_prior: Sequence[float], switches: StatisticSwitches) -> FloatArray:
    """Log of prior, signature and answer, up to a constant of each hop, shape (n, K + 2)."""
    prior = finite_array("reference_prior", reference_prior, (stream.log_likelihoods.shape[1],))
    joint = np.log(prior) + stream.log_likelihoods
    with np.errstate(divide="ignore"):
        joint[:, -2] += _log_visible(stream, switches)
    return np.asarray(joint)


def _log_visible(stream: HopTable, switches: StatisticSwitches) -> FloatArray:
    """Log p(V | visible) / p(V | hidden or none) at every hop."""
    if not switches.use_absence:
        return np.zeros(len(stream))
    beta, answer = stream.miss_rate, stream.answer
    # Where nothing is present the clutter does not matter, and 1 keeps its logarithm finite.
    clutter = np.where(answer == PRESENT, stream.clutter_rate, 1.0)
    present = np.log1p(-beta * (1.0 - clutter)) - np.log(clutter)
    return np.select([answer == ABSENT, answer == PRESENT], [np.log(beta), present], 0.0)
