"""Predictive cues: the calibrated, direction-resolved risk of a hidden road user."""

from dataclasses import dataclass
from typing import Any

from worldstate.ground.reading import Record

from .context import Priors


@dataclass(frozen=True, slots=True)
class RiskCue:
    r"""Risk that a road user is hidden in one direction: an advisory, never a control command.

    .. math:: r_k = g(P(hid \mid y_{1:t}))\, P(k \mid hid, y_{1:t})

    with g the calibrated monotone map of the policy, so that the risks of all directions add up to the risk
    of a hidden road user at all.

    Parameters
    ----------
    direction : str
        Approach side.
    azimuth_rad, azimuth_std_rad : float
        Where to look, coarsely; left positive.
    risk : float
        r_k in [0, 1].
    confidence : float
        P(k | hid): how sure the direction is, given a hidden road user.
    statistic : float
        s of the last window, all directions together, in [0, 1]; what the threshold is compared with.
    log_lambda : float or None
        log Lambda of the last window, nats; None where it is infinite.
    hypotheses : Priors
        Filtered P(hidden), P(visible), P(none).
    advisory : bool
        Whether the sustained rule is in alarm and names this direction.
    alpha : float or None
        False-positive budget that the rule was calibrated for; None for an uncalibrated policy.
    entity_id : str or None
        The hidden entity that it speaks of, if one was born.
    horizon_s : float or None
        Time to arrival of that entity; None where unknown.

    Examples
    --------
    >>> RiskCue("left", 0.9, 0.3, 0.8, 0.95, 0.97, 3.1, Priors(0.9, 0.05, 0.05), True).advisory
    True
    """

    direction: str
    azimuth_rad: float
    azimuth_std_rad: float
    risk: float
    confidence: float
    statistic: float
    log_lambda: float | None
    hypotheses: Priors
    advisory: bool
    alpha: float | None = None
    entity_id: str | None = None
    horizon_s: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values."""
        return {
            "entity_id": self.entity_id,
            "direction": self.direction,
            "azimuth_rad": self.azimuth_rad,
            "azimuth_std_rad": self.azimuth_std_rad,
            "risk": self.risk,
            "confidence": self.confidence,
            "statistic": self.statistic,
            "log_lambda": self.log_lambda,
            "hypotheses": self.hypotheses.to_dict(),
            "horizon_s": self.horizon_s,
            "advisory": self.advisory,
            "alpha": self.alpha,
        }

    @classmethod
    def from_record(cls, record: Record) -> "RiskCue":
        """Return the cue that `to_dict` wrote.

        Raises
        ------
        InvalidArgumentError
            If a value is missing, of the wrong type or out of range.
        """
        return cls(
            direction=record.text("direction"),
            azimuth_rad=record.number("azimuth_rad"),
            azimuth_std_rad=record.number("azimuth_std_rad"),
            risk=record.probability("risk"),
            confidence=record.probability("confidence"),
            statistic=record.probability("statistic"),
            log_lambda=record.maybe("log_lambda", record.number),
            hypotheses=Priors.from_record(record.record("hypotheses")),
            advisory=record.flag("advisory"),
            alpha=record.maybe("alpha", record.probability),
            entity_id=record.maybe("entity_id", record.text),
            horizon_s=record.maybe("horizon_s", record.number),
        )
