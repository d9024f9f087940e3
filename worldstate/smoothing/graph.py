"""What becomes known between two updates of the incremental smoother, and the smoother itself."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from worldstate.ground.typing import FloatArray

from .factors import Factor
from .observations import SmoothingSettings


def _parameters() -> Any:
    import gtsam

    parameters = gtsam.ISAM2Params()
    # Otherwise every factor that was ever marginalised keeps its slot: 4432 after 1500 steps, not 44.
    parameters.findUnusedFactorSlots = True
    # Squared by Cholesky, a range that is not measured is indeterminate.
    parameters.setFactorization("QR")
    return parameters


class FactorGraph:
    """gtsam's incremental fixed-lag smoother, with the factors and values that wait for its next update."""

    def __init__(self, settings: SmoothingSettings) -> None:
        import gtsam

        parameters = _parameters()
        parameters.relinearizeSkip = settings.relinearize_every
        self._smoother: Any = gtsam.IncrementalFixedLagSmoother(settings.lag_s, parameters)
        self._every, self._updates = settings.relinearize_every, 0
        self._near: dict[int, FloatArray] = {}
        self._clear()

    def _clear(self) -> None:
        self._factors: list[Factor] = []
        self._values: dict[int, FloatArray] = {}
        self._times: dict[int, float] = {}

    def add(self, factor: Factor) -> None:
        """Add a factor at the next update."""
        self._factors.append(factor)

    def add_variable(self, key: int, value: FloatArray, time_s: float) -> None:
        """Add a variable at the next update."""
        self._values[key], self._times[key] = value, time_s

    def keep(self, key: int, time_s: float) -> None:
        """Keep a variable for another lag."""
        self._times[key] = time_s

    def update(self) -> None:
        """Take in what has been added."""
        import gtsam

        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for factor in self._factors:
            graph.push_back(factor)
        for key, value in self._values.items():
            values.insert(key, value)
        self._updates += 1
        self._smoother.update(graph, values, self._times)
        # One estimate costs as much as all, a quarter of an update: in between, what variables began with is
        # near enough to begin the next ones with.
        self._near = {} if self._updates % self._every == 0 else self._near | self._values
        self._clear()

    def value(self, key: int) -> FloatArray:
        """Return an estimate of a variable, no older than the last relinearisation."""
        if key in self._values:
            return self._values[key]
        if key not in self._near:
            self._near[key] = self._smoother.calculateEstimateVector(key)
        return self._near[key]

    @property
    def n_factor_slots(self) -> int:
        """How many factors the graph has room for, used or not."""
        return int(self._smoother.getFactors().size())

    def refined(self, keys: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of variables, all that lies within the lag relinearised to the end."""
        import gtsam

        graph, slots = gtsam.NonlinearFactorGraph(), self._smoother.getFactors()
        for i in range(slots.size()):
            if slots.exists(i):
                graph.push_back(slots.at(i))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        parameters.setRelativeErrorTol(1e-12)
        parameters.setAbsoluteErrorTol(1e-12)
        parameters.setMaxIterations(30)
        start = self._smoother.getLinearizationPoint()
        values = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()
        # gtsam's `Marginals` know Cholesky only from Python, which finds them indeterminate.
        solved = gtsam.ISAM2(_parameters())
        solved.update(graph, values)
        return np.array([*map(values.atVector, keys)]), np.array([*map(solved.marginalCovariance, keys)])
