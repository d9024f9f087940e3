"""What becomes known between two updates of the incremental smoother, and the smoother itself."""

from collections import defaultdict
from typing import Any

import numpy as np

from worldstate.ground.typing import FloatArray

from .factors import CORNER, EGO, WALL, Factor, kind_of
from .observations import SmoothingSettings

# Updates between two sums of what marginalised entities left: a minute at ten a second.
_SUMMED_EVERY = 600


def _parameters() -> Any:
    import gtsam

    parameters = gtsam.ISAM2Params()
    # Otherwise every factor that was ever marginalised keeps its slot: 4432 after 1500 steps, not 44.
    parameters.findUnusedFactorSlots = True
    # Squared by Cholesky, a pose known to 1e-4 rad beside a range that is not measured is indeterminate.
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
            values.insert(key, gtsam.Pose2(*value) if kind_of(key) == EGO else value)
        self._updates += 1
        summed = self._summed_marginals(graph) if self._updates % _SUMMED_EVERY == 0 else []
        self._smoother.update(graph, values, self._times, summed)
        # One estimate costs as much as all, a quarter of an update: in between, what variables began with is
        # near enough to begin the next ones with.
        self._near = {} if self._updates % self._every == 0 else self._near | self._values
        self._clear()

    def _summed_marginals(self, graph: Any) -> list[int]:
        """Add one factor for all that marginalised entities left on the same landmarks; return their slots.

        Every entity that ended at a corner leaves a quadratic one; kept apart, they grow with the hours.
        """
        import gtsam

        slots = self._smoother.getFactors()
        left = defaultdict[tuple[int, ...], list[int]](list)
        for i in range(slots.size()):
            if slots.exists(i) and isinstance(slots.at(i), gtsam.LinearContainerFactor):
                left[tuple(sorted(slots.at(i).keys()))].append(i)
        alike = {
            keys: places
            for keys, places in left.items()
            if all(kind_of(key) in (CORNER, WALL) for key in keys) and len(places) > 1
        }
        for places in alike.values():
            linear = gtsam.GaussianFactorGraph()
            for i in places:
                linear.push_back(slots.at(i).factor())
            # No linearisation point, as gtsam's own have none: it holds that of their variables fixed.
            graph.push_back(gtsam.LinearContainerFactor(gtsam.HessianFactor(linear)))
        return [i for places in alike.values() for i in places]

    def value(self, key: int) -> FloatArray:
        """Return an estimate of a variable, no older than the last relinearisation."""
        if key in self._values:
            return self._values[key]
        if key not in self._near:
            self._near[key] = self._estimate(key)
        return self._near[key]

    def _estimate(self, key: int) -> FloatArray:
        if kind_of(key) == EGO:
            pose = self._smoother.calculateEstimatePose2(key)
            return np.array([pose.x(), pose.y(), pose.theta()])
        return self._smoother.calculateEstimateVector(key)  # type: ignore[no-any-return]

    @property
    def n_factor_slots(self) -> int:
        """How many factors the graph has room for, used or not."""
        return int(self._smoother.getFactors().size())

    def refined(self) -> "Refined":
        """Return all that lies within the lag, relinearised until it no longer moves."""
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
        return Refined(solved, values)


class Refined:
    """The converged estimate and its covariances."""

    def __init__(self, solved: Any, values: Any) -> None:
        self._values, self._solved = values, solved

    def value(self, key: int) -> FloatArray:
        """Return the estimate of a vector variable."""
        return self._values.atVector(key)  # type: ignore[no-any-return]

    def pose(self, key: int) -> FloatArray:
        """Return the estimate of a pose."""
        found = self._values.atPose2(key)
        return np.array([found.x(), found.y(), found.theta()])

    def covariance(self, key: int) -> FloatArray:
        """Return the covariance of one variable."""
        return self._solved.marginalCovariance(key)  # type: ignore[no-any-return]

    def joint_covariance(self, one: int, other: int) -> FloatArray:
        """Return the covariance of two variables, in this order."""
        found = self._solved.jointMarginalCovariance([one, other])
        return np.block([[found.at(a, b) for b in (one, other)] for a in (one, other)])
