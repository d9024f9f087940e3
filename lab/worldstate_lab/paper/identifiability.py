"""Limits of any detector, computed for an array and for a data set."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.spatial import cKDTree
from scipy.special import digamma, entr

from worldstate.abduction.signature.window_classes import CLASSES
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.bounds.cramer_rao import bearing_crb_rad2, endfire_information
from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import AnyArray, FloatArray, IndexArray
from worldstate_lab.features.feature_evaluation import method_of
from worldstate_lab.metrics.intervals import pooled_draws

# Estimators use nats, the paper and the report bits.
_BITS = 1.0 / math.log(2.0)
_NEIGHBOURS = 3
# A single posterior of exactly zero at the true state would make the mean over all windows infinite.
_SMALLEST = 1e-12


class Information(NamedTuple):
    """Estimates of I(z; x) from the posteriors of a classifier, bits.

    In expectation, `lower` is a lower bound for any classifier on windows outside its training set. `plug_in`
    is valid for a calibrated classifier and too high for an overconfident one.

    Parameters
    ----------
    lower : float
        Variational lower bound.
    plug_in : float
        Entropy of the labels minus the mean entropy of the posteriors.

    Examples
    --------
    >>> Information(lower=0.41, plug_in=0.45).lower
    0.41
    """

    lower: float
    plug_in: float


def entropy_bits(probabilities: ArrayLike) -> float:
    r"""Return :math:`H = -\sum_k p_k \log_2 p_k`.

    Shapes: probabilities (K,).

    References
    ----------
    C. E. Shannon, "A mathematical theory of communication", Bell Syst. Tech. J. 27, 1948.
    """
    return float(entr(np.asarray(probabilities)).sum()) * _BITS


def information_from_posteriors(posteriors: ArrayLike, states: ArrayLike) -> Information:
    r"""Estimate I(z; x) from posteriors q(z | x) of windows outside the classifier's training set.

    .. math::
        I(z; x) \ge H(z) + \overline{\log_2 q(z_i | x_i)}, \qquad
        \hat I_{plug} = H(z) - \overline{H(q(\cdot | x_i))}.

    The first is the variational lower bound of Barber and Agakov, which is tight if q is the true posterior.
    The second is also exact in that case, but otherwise not a bound. H(z) is the entropy of the given labels,
    corrected for its plug-in bias of :math:`(K - 1) / 2n` nats (Miller and Madow).

    Parameters
    ----------
    posteriors : array_like, shape (n, K)
        Rows that sum to one.
    states : array_like of int, shape (n,)
        True states, 0 to K - 1.

    Returns
    -------
    Information
        Bits.

    References
    ----------
    D. Barber and F. Agakov, "The IM algorithm: a variational approach to information maximization", 2003.

    Examples
    --------
    >>> sure = information_from_posteriors([[1.0, 0.0], [0.0, 1.0]] * 500, [0, 1] * 500)
    >>> round(sure.lower, 2), round(sure.plug_in, 2)
    (1.0, 1.0)
    """
    q, z = np.asarray(posteriors), np.asarray(states)
    own = np.log2(np.maximum(q[np.arange(z.size), z], _SMALLEST))
    spread = -(q * np.log2(np.maximum(q, _SMALLEST))).sum(axis=1)
    prior = state_entropy_bits(z, q.shape[1])
    return Information(prior + float(own.mean()), prior - float(spread.mean()))


def state_entropy_bits(states: ArrayLike, count: int) -> float:
    r"""Return the entropy of labels, corrected for small samples, at most log2 of their number.

    .. math:: \hat H = \min\Big(-\sum_k \hat p_k \log_2 \hat p_k + \frac{K_+ - 1}{2 n \ln 2},\; \log_2 K\Big)

    where K_+ is the number of labels that occur.

    Shapes: states (n,).

    References
    ----------
    G. A. Miller, "Note on the bias of information estimates", 1955.

    Examples
    --------
    >>> round(state_entropy_bits([0, 1, 0, 1], 2), 3)
    1.0
    """
    z = np.asarray(states)
    shares = np.bincount(z, minlength=count) / z.size
    bias = ((shares > 0).sum() - 1) / (2.0 * z.size) * _BITS
    return min(entropy_bits(shares) + float(bias), math.log2(max(count, 1)))


def nearest_neighbour_information_bits(features: ArrayLike, states: ArrayLike) -> float:
    r"""Estimate I(z; x) from distances only, without a classifier.

    .. math:: \hat I = \psi(n) + \psi(k) - \overline{\psi(n_{z_i})} - \overline{\psi(m_i)},

    with n_z windows of the state of i and m_i windows of any state within the distance of the k-th neighbour
    of its own state. The estimate is consistent, with a negative bias that grows with the dimension: reduce
    features to a few components first. Distances are the largest difference of any component, so scale the
    components equally.

    Parameters
    ----------
    features : array_like, shape (n, d)
        Continuous values.
    states : array_like of int, shape (n,)
        True states; those with no more than k = 3 windows are left out.

    Returns
    -------
    float
        Bits; may be negative by chance.

    Raises
    ------
    InvalidArgumentError
        If no state has enough windows.

    References
    ----------
    Ross, "Mutual information between discrete and continuous data sets", 2014.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> z = rng.integers(0, 2, 2000)
    >>> round(nearest_neighbour_information_bits(rng.normal(size=(2000, 1)) + 8.0 * z[:, None], z), 1)
    1.0
    """
    x, z, k = np.asarray(features), np.asarray(states), _NEIGHBOURS
    names, counts = np.unique(z, return_counts=True)
    kept = np.isin(z, names[counts > k])
    x, z = x[kept], z[kept]
    if not z.size:
        raise InvalidArgumentError(f"states: expected a state with more than {k} windows")
    radius, own = np.empty(z.size), np.empty(z.size)
    for name in np.unique(z):
        rows = np.flatnonzero(z == name)
        distance, _ = cKDTree(x[rows]).query(x[rows], k=k + 1, p=np.inf)
        radius[rows], own[rows] = np.nextafter(distance[:, -1], 0.0), rows.size
    within = cKDTree(x).query_ball_point(x, radius, p=np.inf, return_length=True)
    nats = digamma(z.size) + digamma(k) - digamma(own).mean() - digamma(np.maximum(within, 1)).mean()
    return max(float(nats) * _BITS, 0.0)


def fano_bound(entropy: float, information: float, states: int) -> float:
    r"""Return the paper's lower bound on the error probability of any detector, in [0, 1].

    .. math:: P_e \ge \frac{H(z) - I(z; x) - 1}{\log_2 K}

    It bounds all detectors only if I is not below the true value: with the lower bound of
    `information_from_posteriors` it becomes an estimate. If H is two bits or less, it is often void; see
    `sharp_fano_bound`.

    Parameters
    ----------
    entropy, information : float
        H(z) and I(z; x), bits.
    states : int
        K >= 2.

    Returns
    -------
    float
        In [0, 1].

    References
    ----------
    "Evidence of Absence", proposition 1, part (i).

    Examples
    --------
    >>> fano_bound(entropy=2.0, information=0.2, states=4)
    0.4
    """
    return min(max((entropy - max(information, 0.0) - 1.0) / math.log2(states), 0.0), 1.0)


def sharp_fano_bound(entropy: float, information: float, states: int) -> float:
    r"""Return the smallest error probability that Fano's inequality permits, in its exact form.

    .. math:: h(P_e) + P_e \log_2 (K - 1) \ge H(z) - I(z; x),

    with the binary entropy h, solved for the smallest P_e. It is never below `fano_bound`, and the symmetric
    channel attains it.

    Parameters
    ----------
    entropy, information : float
        H(z) and I(z; x), bits.
    states : int
        K >= 2.

    Returns
    -------
    float
        In [0, 1 - 1/K].

    References
    ----------
    T. M. Cover and J. A. Thomas, *Elements of Information Theory*, 1991, chapter 2 (Fano's inequality).

    Examples
    --------
    >>> round(sharp_fano_bound(entropy=1.0, information=0.5310, states=2), 3)
    0.1
    """
    remaining, largest = entropy - max(information, 0.0), (states - 1.0) / states
    if remaining <= 0.0:
        return 0.0
    if remaining >= math.log2(states) - 1e-12:
        return largest

    def surplus(error: float) -> float:
        return entropy_bits((error, 1.0 - error)) + error * math.log2(states - 1) - remaining

    return float(brentq(surplus, 0.0, largest))


# In more dimensions, a kNN estimate from a few hundred windows is far below the true value.
_COMPONENTS = 3
# The standard deviation over this many draws has a relative error of 5 %.
_BOOTSTRAPS = 200


@dataclass(frozen=True, slots=True)
class ReachOnData:
    """Bounds on the accuracy with which a data set's features determine its states, for any classifier."""

    states: int  # Number of states K; the next field is the number of windows n
    windows: int
    entropy_bits: float  # H(z)
    # Estimates of I(z; x), bits: variational lower bound and plug-in from the posteriors, and kNN on the
    # leading components of the features.
    information_lower: float
    information_plug_in: float
    information_neighbours: float
    # The largest estimate plus two bootstrap standard deviations, at which the bound is evaluated.
    information_high: float
    error: float  # Error of the classifier itself
    # Lower bounds on the error of any detector, if the information is not above `information_high`: the
    # paper's form and the exact form.
    fano: float
    sharp_fano: float


def reach_on_data(
    posteriors: FloatArray,
    states: IndexArray,
    features: FloatArray,
    groups: AnyArray,
    rng: np.random.Generator,
) -> ReachOnData:
    """Bound the error of any detector on windows like these.

    Fano's inequality needs an upper bound of I(z; x), but data give a lower bound or a biased estimate: the
    bound is evaluated at the largest of three estimates plus two standard deviations over a bootstrap of
    recordings. It is an estimate of a bound and not a proof.

    Parameters
    ----------
    posteriors : ndarray, shape (n, K)
        Of windows outside the classifier's training set.
    states : ndarray of int, shape (n,)
        True states, 0 to K - 1.
    features : ndarray, shape (n, d)
        For the kNN estimate.
    groups : ndarray, shape (n,)
        Recording of each window.
    rng : numpy.random.Generator
        Draws the bootstrap.

    Returns
    -------
    ReachOnData
        Information in bits, the two bounds, and the classifier's own error.

    Examples
    --------
    >>> z = np.arange(400) % 2
    >>> q = np.where(z[:, None] == np.arange(2), 0.9, 0.1)
    >>> found = reach_on_data(q, z, q, np.arange(400), np.random.default_rng(0))
    >>> round(found.information_plug_in, 2), found.error
    (0.53, 0.0)
    """
    found = information_from_posteriors(posteriors, states)
    # On the leading components of the standardised features.
    spread = features.std(axis=0)
    standard = (features - features.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    _, _, axes = np.linalg.svd(standard, full_matrices=False)
    leading = standard @ axes[:_COMPONENTS].T
    near = nearest_neighbour_information_bits(leading / leading.std(axis=0), states)
    count = posteriors.shape[1]
    entropy = state_entropy_bits(states, count)
    largest = max(found.lower, found.plug_in, near)
    high = min(largest + 2.0 * _spread(posteriors, states, groups, rng), entropy)
    return ReachOnData(
        states=count,
        windows=len(states),
        entropy_bits=entropy,
        information_lower=found.lower,
        information_plug_in=found.plug_in,
        information_neighbours=near,
        information_high=high,
        error=float(np.mean(posteriors.argmax(axis=1) != states)),
        fano=fano_bound(entropy, high, count),
        sharp_fano=sharp_fano_bound(entropy, high, count),
    )


def reach_on_table(table: FeatureTable, method: str, rng: np.random.Generator) -> ReachOnData:
    """Bound the error of any classifier on a table's windows, and add a method's out-of-fold error."""
    # The table is prepared with curated references.
    chosen = method_of(method)
    posteriors = replace(chosen, reference=None).posteriors(chosen.prepare(table), rng)
    states = np.array([CLASSES.index(label) for label in table.labels.tolist()])
    return reach_on_data(posteriors, states, np.log(table.features), table.recording_keys, rng)


@dataclass(frozen=True, slots=True, eq=False)
class ReachOfArray:
    """Smallest bearing error that an array permits, by the Cramer-Rao bound."""

    azimuths_rad: FloatArray  # shape (n,): Requested directions
    # shape (n,): Smallest standard deviation of any unbiased estimator; inf at endfire of a line array.
    std_rad: FloatArray
    # shape (n,): The same if a camera of `vision_std_rad` also sees the source, under (A1).
    with_vision_rad: FloatArray
    # shape (n,): Bearing information relative to the best direction, cos^2 in the corollary.
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
    remain observable where it is not.

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

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import roof_array_56
    >>> found = reach_of_array(roof_array_56(), [0.0, 1.5], [500.0, 1000.0], [0.1, 0.1], snapshots=40)
    >>> bool(found.std_rad[0] < found.std_rad[1])
    True
    """
    azimuths = finite_array("azimuths_rad", azimuths_rad, (None,))
    variance = np.array(
        [
            bearing_crb_rad2(array.positions_m, azimuth, frequencies_hz, snr, snapshots, random_signal=True)
            for azimuth in azimuths.tolist()
        ]
    )
    heard = np.divide(1.0, variance, out=np.zeros_like(variance), where=np.isfinite(variance))
    std = np.sqrt(variance)
    with np.errstate(divide="ignore"):
        together = 1.0 / np.sqrt(heard + vision_std_rad**-2)
    return ReachOfArray(
        azimuths_rad=azimuths,
        # Round-off leaves a little information at endfire: a standard deviation above half a turn means no
        # bearing.
        std_rad=np.where(std > math.pi, math.inf, std),
        with_vision_rad=together,
        endfire=endfire_information(array.positions_m, azimuths),
    )


def _spread(q: FloatArray, states: IndexArray, groups: AnyArray, rng: np.random.Generator) -> float:
    """Return the bootstrap standard deviation of the lower bound, with draws of whole recordings."""
    units = np.unique(groups, return_inverse=True)[1]
    order = np.argsort(units, kind="stable")
    rows = np.split(order, np.cumsum(np.bincount(units))[:-1])
    chosen = pooled_draws(rows, [0] * len(rows), rng, _BOOTSTRAPS)
    return float(np.std([information_from_posteriors(q[one], states[one]).lower for one in chosen]))
