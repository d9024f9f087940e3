"""What the library says by itself: its shipped model, learning its site, past its own noise, and filtered."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate_lab.trials.trial import Decide, Trial


@dataclass(frozen=True, slots=True)
class ShippedChain:
    """One variant of the whole chain, at its model's thresholds; nothing is set on the recordings."""

    name: str
    chain: str

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Return what was said while listening."""
        return lambda trial: trial.chains[self.chain]
