r"""Running level of the noise that is there without an approaching source.

From the lower quantiles of the log-energies of the last half minute, as of a normal distribution:

.. math:: \sigma = \frac{q_{30} - q_{10}}{\Phi^{-1}(.3) - \Phi^{-1}(.1)}, \qquad
          \log N = q_{30} - \Phi^{-1}(.3)\, \sigma
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

# An approach is heard for three to six seconds: of half a minute it leaves the lower third to the noise, of
# less than five seconds not.
_LONGEST_HOPS, _FEWEST_HOPS = 300, 50
_Z10, _Z30 = -1.2816, -0.5244
# As long as too little was heard, the noise is between nothing and the lowest energy of the window.
_UNKNOWN_SHARE = 0.25


@dataclass(frozen=True, slots=True)
class NoiseEnergy:
    """Mean energy of the noise and its standard deviation, in the unit of the energies."""

    mean: float
    std: float


class EnergyFloor:
    """Energies of the last hops."""

    def __init__(self) -> None:
        self._log_energies: deque[float] = deque(maxlen=_LONGEST_HOPS)

    def push(self, energy: float) -> None:
        """Take the energy of a hop; silence is left out."""
        if energy > 0.0:
            self._log_energies.append(math.log(energy))

    def read(self, lowest: float, least_log_std: float) -> NoiseEnergy:
        """Return the noise; of a stream that has just begun only that it is below the lowest energy."""
        count = len(self._log_energies)
        if count < _FEWEST_HOPS:
            return NoiseEnergy(0.0, _UNKNOWN_SHARE * lowest)
        tenth, third = count // 10, 3 * count // 10
        ordered = np.partition(np.fromiter(self._log_energies, np.float64, count), (tenth, third))
        spread = max(float(ordered[third] - ordered[tenth]) / (_Z30 - _Z10), least_log_std)
        mean = math.exp(float(ordered[third]) - _Z30 * spread)
        return NoiseEnergy(mean, spread * mean)
