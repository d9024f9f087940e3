"""Settings of the fixed-lag smoother."""

import math
from dataclasses import dataclass

from worldstate.ground.checks import in_range


@dataclass(frozen=True, slots=True)
class SmoothingSettings:
    r"""How far back the smoother corrects, and how vehicles are taken to drive.

    Parameters
    ----------
    lag_s : float
        How long states stay in the graph, s: longer than anybody is heard before he is seen.
    acceleration_psd : float
        Density of the white acceleration, m^2/s^3.
    robust_k : float
        Residual in standard deviations from which on the Huber loss of bearings, approach rates and boxes
        grows linearly.
    manoeuvre_k : float or None
        Scale of the Cauchy loss of the motion between two states, whose whitened norm is 2 in the mean.
        A driver then keeps the pace most of the time, and now and then brakes, accelerates or turns off,
        at a lower cost than as white acceleration. None for a Gaussian.
    range_m, range_log_std : float
        Prior of the distance at which an entity is first observed, and its deviation as a factor's logarithm.
    edge_std_rad : float
        How sharply line of sight begins at an edge: a vehicle is no point.
    relinearize_every : int
        Updates between two relinearisations.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> SmoothingSettings(lag_s=20.0).acceleration_psd
    1.0
    """

    lag_s: float = 15.0
    acceleration_psd: float = 1.0
    # 95 % as efficient as least squares where all residuals are Gaussian (Huber, 1981).
    robust_k: float = 1.345
    manoeuvre_k: float | None = None
    range_m: float = 25.0
    range_log_std: float = 0.7
    edge_std_rad: float = math.radians(1.0)
    # Relinearising at every update costs four times as much and moves the result by less than a percent.
    relinearize_every: int = 10

    def __post_init__(self) -> None:
        in_range("lag_s", self.lag_s, 0.0, 600.0, open_low=True)
        positive = ("acceleration_psd", "robust_k", "range_m", "range_log_std", "edge_std_rad")
        for name in positive:
            in_range(name, getattr(self, name), 0.0, 1e6, open_low=True)
        if self.manoeuvre_k is not None:
            in_range("manoeuvre_k", self.manoeuvre_k, 0.0, 1e6, open_low=True)
        in_range("relinearize_every", self.relinearize_every, 1, 1000)
