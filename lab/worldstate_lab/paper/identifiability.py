"""What could any detector reach here? Asked of an array, and of a data set."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from worldstate.abduction.signature.window_classes import CLASSES
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.bounds.cramer_rao import bearing_crb_rad2, endfire_information
from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray, IndexArray
from worldstate_lab.features.methods import method_of
from worldstate_lab.paper.information import (
    fano_bound,
    information_from_posteriors,
    nearest_neighbour_information_bits,
    sharp_fano_bound,
    state_entropy_bits,
)

# A kNN estimate in more dimensions than this is far below the truth at a few hundred windows.
_COMPONENTS = 3
# A standard deviation over so many draws is known to 5 %.
_BOOTSTRAPS = 200


@dataclass(frozen=True, slots=True)
class ReachOnData:
    """Bounds on how well the state of a data set's windows can be told from their features."""

    states: int  # K and n
    windows: int
    entropy_bits: float  # H(z)
    # Estimates of I(z; x), bits: variational lower bound and plug-in from the posteriors, and kNN on the
    # leading components of the features (NaN without features).
    information_lower: float
    information_plug_in: float
    information_neighbours: float
    # The largest estimate plus two bootstrap standard deviations: what the bound is stated at.
    information_high: float
    error: float  # Of the classifier itself
    # No detector errs less than this, if the information is not above `information_high`: the paper's form
    # and the one without its slack.
    fano: float
    sharp_fano: float


def reach_on_data(
    posteriors: ArrayLike,
    states: ArrayLike,
    rng: np.random.Generator,
    *,
    features: ArrayLike | None = None,
    groups: ArrayLike | None = None,
) -> ReachOnData:
    """Bound the error of any detector on windows like these.

    Fano's inequality needs I(z; x) from above, and data give it from below or with a bias: the bound is
    stated at the largest of three estimates plus two standard deviations over a bootstrap of recordings. It
    is an estimate of a bound, no proof.

    Parameters
    ----------
    posteriors : array_like, shape (n, K)
        Of windows that the classifier was not trained on.
    states : array_like of int, shape (n,)
        True states, 0 to K - 1.
    rng : numpy.random.Generator
        Draws the bootstrap.
    features : array_like, shape (n, d), optional
        For the kNN estimate.
    groups : array_like, shape (n,), optional
        Recording of each window; windows stand alone where not given.

    Returns
    -------
    ReachOnData
        Information in bits, the two bounds, and the classifier's own error.

    Raises
    ------
    InvalidArgumentError
        If shapes do not fit or there are fewer than two states.

    Examples
    --------
    >>> z = np.arange(400) % 2
    >>> q = np.where(z[:, None] == np.arange(2), 0.9, 0.1)
    >>> found = reach_on_data(q, z, np.random.default_rng(0))
    >>> round(found.information_plug_in, 2), found.error
    (0.53, 0.0)
    """
    q, z = finite_array("posteriors", posteriors, (None, None)), np.asarray(states)
    if q.shape[1] < 2:
        raise InvalidArgumentError(f"posteriors: expected at least two states, got {q.shape[1]}")
    found = information_from_posteriors(q, z)
    near = math.nan if features is None else _neighbours(features, z)
    units = np.arange(len(q)) if groups is None else np.unique(np.asarray(groups), return_inverse=True)[1]
    entropy = state_entropy_bits(z, q.shape[1])
    largest = float(np.nanmax([found.lower, found.plug_in, near]))
    high = min(largest + 2.0 * _spread(q, z, units, rng), entropy)
    return ReachOnData(
        states=q.shape[1],
        windows=len(q),
        entropy_bits=entropy,
        information_lower=found.lower,
        information_plug_in=found.plug_in,
        information_neighbours=near,
        information_high=high,
        error=float(np.mean(q.argmax(axis=1) != z)),
        fano=fano_bound(entropy, high, q.shape[1]),
        sharp_fano=sharp_fano_bound(entropy, high, q.shape[1]),
    )


def reach_on_table(table: FeatureTable, method: str, rng: np.random.Generator) -> ReachOnData:
    """Bound the error of any classifier of the windows of a table, beside that of a method out of fold."""
    # Asked as prepared: about windows compared with curated ones.
    chosen = method_of(method)
    posteriors = replace(chosen, reference=None).posteriors(chosen.prepare(table), rng)
    states = np.array([CLASSES.index(label) for label in table.labels.tolist()])
    features = np.log(table.features)
    return reach_on_data(posteriors, states, rng, features=features, groups=table.recording_keys)


@dataclass(frozen=True, slots=True, eq=False)
class ReachOfArray:
    """How well a bearing could be told with an array, by the Cramer-Rao bound."""

    azimuths_rad: FloatArray  # shape (n,): Directions asked for
    # shape (n,): Smallest standard deviation of any unbiased estimator; inf at endfire of a line array.
    std_rad: FloatArray
    # shape (n,): The same once a camera of `vision_std_rad` sees the source too, under (A1).
    with_vision_rad: FloatArray
    # shape (n,): Bearing information relative to the best direction, the corollary's cos^2.
    endfire: FloatArray


def reach_of_array(
    array: MicrophoneArray,
    azimuths_rad: ArrayLike,
    frequencies_hz: ArrayLike,
    snr: ArrayLike,
    snapshots: int,
    *,
    vision_std_rad: float = math.inf,
) -> ReachOfArray:
    r"""Bound the bearing error of any unbiased estimator, alone and with a camera.

    .. math:: \sigma(\theta) \ge (J_{ac} + J_{vis})^{-1/2}, \qquad J_{ac} \propto \cos^2\theta\, S_{xx}

    for an array across the vehicle. Presence, approach speed and coarse side do not depend on the bearing and
    remain where this one is lost.

    Parameters
    ----------
    array : MicrophoneArray
        The microphones.
    azimuths_rad : array_like, shape (n,)
        Left positive.
    frequencies_hz, snr : array_like, shape (bins,)
        Band of the source and its power ratio at one microphone in each bin.
    snapshots : int
        Independent snapshots.
    vision_std_rad : float
        Of the camera; inf without one.

    Returns
    -------
    ReachOfArray
        Standard deviations, shape (n,), and the share of the best direction's information.

    Raises
    ------
    InvalidArgumentError
        As `frontend.bounds.cramer_rao.bearing_crb_rad2`.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import roof_array_56
    >>> found = reach_of_array(roof_array_56(), [0.0, 1.5], [500.0, 1000.0], [0.1, 0.1], snapshots=40)
    >>> bool(found.std_rad[0] < found.std_rad[1])
    True
    """
    azimuths = finite_array("azimuths_rad", azimuths_rad, (None,))
    seen = _vision_information(vision_std_rad)
    variance = np.array(
        [
            bearing_crb_rad2(array.positions_m, azimuth, frequencies_hz, snr, snapshots, random_signal=True)
            for azimuth in azimuths.tolist()
        ]
    )
    heard = np.divide(1.0, variance, out=np.zeros_like(variance), where=np.isfinite(variance))
    std = np.sqrt(variance)
    return ReachOfArray(
        azimuths_rad=azimuths,
        # Round-off leaves a sliver of information at endfire: a spread beyond half a turn is no bearing.
        std_rad=np.where(std > math.pi, math.inf, std),
        with_vision_rad=_deviation(heard + seen),
        endfire=endfire_information(array.positions_m, azimuths),
    )


def _vision_information(std_rad: float) -> float:
    if std_rad == math.inf:
        return 0.0
    return float(1.0 / in_range("vision_std_rad", std_rad, 0.0, math.inf, open_low=True) ** 2)


def _deviation(information: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.sqrt(information))


def _neighbours(features: ArrayLike, states: NDArray[np.int_]) -> float:
    """Return the kNN estimate on the leading components of the standardised features."""
    x = finite_array("features", features, (len(states), None))
    spread = x.std(axis=0)
    x = (x - x.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    _, _, axes = np.linalg.svd(x, full_matrices=False)
    components = x @ axes[:_COMPONENTS].T
    return nearest_neighbour_information_bits(components / components.std(axis=0), states)


def _spread(q: FloatArray, states: NDArray[np.int_], units: IndexArray, rng: np.random.Generator) -> float:
    """Return the bootstrap standard deviation of the lower bound, whole recordings drawn."""
    order = np.argsort(units, kind="stable")
    rows = np.split(order, np.cumsum(np.bincount(units))[:-1])
    draws = []
    for _ in range(_BOOTSTRAPS):
        chosen = np.concatenate([rows[i] for i in rng.integers(0, len(rows), len(rows))])
        draws.append(information_from_posteriors(q[chosen], states[chosen]).lower)
    return float(np.std(draws))
