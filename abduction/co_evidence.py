"""Answers of a co-evidence channel: present, absent, or unqueried.

Absence is a measurement and has a type of its own. A sensor that was not asked gives neither presence nor
absence: `Unqueried`, beta = 1.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import check_fields, in_range


@dataclass(frozen=True, slots=True)
class Absent:
    """The sector was searched and the co-evidence is not there.

    Parameters
    ----------
    miss_rate : float
        beta_c(theta, d): probability that a visible source of this class is missed, in [0, 1].
    clutter_rate : float
        Probability that the channel reports co-evidence where there is none, in [0, 1).

    Examples
    --------
    >>> Absent(miss_rate=0.04).log_likelihoods().round(3)
    array([ 0.   , -3.219,  0.   ])
    """

    miss_rate: float
    clutter_rate: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "miss_rate", in_range("miss_rate", self.miss_rate, 0.0, 1.0))
        clutter = in_range("clutter_rate", self.clutter_rate, 0.0, 1.0, open_high=True)
        object.__setattr__(self, "clutter_rate", clutter)

    def log_likelihoods(self) -> np.ndarray:
        r"""Log p(absent | hidden, visible, none), shape (3,), nats; -inf where impossible.

        .. math:: p = \big(1 - \kappa,\; \beta\, (1 - \kappa),\; 1 - \kappa\big)

        with beta the miss rate and kappa the clutter rate.

        Returns
        -------
        ndarray, shape (3,)
            Nats.

        References
        ----------
        "Evidence of Absence", eq. (6). An empty sector needs that nothing is found by mistake.
        """
        spurious = np.log1p(-self.clutter_rate)
        with np.errstate(divide="ignore"):
            missed = np.log(self.miss_rate)
        return np.array([spurious, missed + spurious, spurious]) + 0.0


@dataclass(frozen=True, slots=True)
class Present:
    """The sector was searched and the co-evidence is there.

    Parameters
    ----------
    miss_rate : float
        beta_c(theta, d) of the channel, in [0, 1].
    clutter_rate : float
        Probability of co-evidence where there is no such source, in (0, 1): with zero a single false
        detection would remove the hidden explanation for ever.

    Examples
    --------
    >>> Present(miss_rate=0.04, clutter_rate=0.01).log_likelihoods().round(2)
    array([-4.61, -0.04, -4.61])
    """

    miss_rate: float
    clutter_rate: float = 0.01

    def __post_init__(self) -> None:
        object.__setattr__(self, "miss_rate", in_range("miss_rate", self.miss_rate, 0.0, 1.0))
        clutter = in_range("clutter_rate", self.clutter_rate, 0.0, 1.0, open_low=True, open_high=True)
        object.__setattr__(self, "clutter_rate", clutter)

    def log_likelihoods(self) -> np.ndarray:
        r"""Log p(present | hidden, visible, none), shape (3,), nats.

        .. math:: p = \big(\kappa,\; 1 - \beta\, (1 - \kappa),\; \kappa\big)

        with beta the miss rate and kappa the clutter rate.

        Returns
        -------
        ndarray, shape (3,)
            Nats.

        References
        ----------
        Derived here: the complement of `Absent`.
        """
        spurious = np.log(self.clutter_rate)
        found = np.log1p(-self.miss_rate * (1.0 - self.clutter_rate))
        return np.array([spurious, found, spurious])


@dataclass(frozen=True, slots=True)
class Unqueried:
    """The channel was not asked: no frame, outside its field of view, or no such sensor.

    Parameters
    ----------
    reason : str
        For people and logs.

    Examples
    --------
    >>> Unqueried("no detections file").log_likelihoods()
    array([0., 0., 0.])
    """

    reason: str

    def __post_init__(self) -> None:
        check_fields(self, reason=str)

    def log_likelihoods(self) -> np.ndarray:
        """Zero for every explanation, shape (3,): beta = 1, it moves nothing.

        ``log p = 0`` for all.

        Returns
        -------
        ndarray, shape (3,)
            Zeros.

        References
        ----------
        "Evidence of Absence", eq. (6) with beta = 1.
        """
        return np.zeros(3)


CoEvidence = Absent | Present | Unqueried
