r"""Mutual information between observation and hidden state, and the error bounds that follow from it."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import check_shape, finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray, IndexArray

# Estimators count in nats, the paper and the report in bits.
_BITS = 1.0 / math.log(2.0)
# One posterior of exactly zero at the true state would make the mean of all windows infinite.
_SMALLEST = 1e-12


class Information(NamedTuple):
    """Estimates of I(z; x) from the posteriors of a classifier, bits.

    `lower` holds for any classifier on windows that it was not trained on, in expectation; `plug_in` for a
    calibrated one, and is too high for one that is too sure of itself.

    Parameters
    ----------
    lower : float
        Variational lower bound.
    plug_in : float
        Entropy of the labels less the mean entropy of the posteriors.

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
    p = _distribution("probabilities", finite_array("probabilities", probabilities, (None,)))
    positive = p[p > 0.0]
    return max(float(-(positive * np.log2(positive)).sum()), 0.0)


def information_from_posteriors(posteriors: ArrayLike, states: ArrayLike) -> Information:
    r"""Estimate I(z; x) from posteriors q(z | x) of windows that the classifier was not trained on.

    .. math::
        I(z; x) \ge H(z) + \overline{\log_2 q(z_i | x_i)}, \qquad
        \hat I_{plug} = H(z) - \overline{H(q(\cdot | x_i))}.

    The first is the variational lower bound of Barber and Agakov, tight where q is the true posterior; the
    second is tight there too, but nothing bounds it elsewhere. H(z) is that of the labels given; its plug-in
    bias of :math:`(K - 1) / 2n` nats is added back (Miller and Madow).

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

    Raises
    ------
    InvalidArgumentError
        If shapes differ, a row is no distribution or a state is none.

    References
    ----------
    D. Barber and F. Agakov, "The IM algorithm: a variational approach to information maximization", 2003.

    Examples
    --------
    >>> sure = information_from_posteriors([[1.0, 0.0], [0.0, 1.0]] * 500, [0, 1] * 500)
    >>> round(sure.lower, 2), round(sure.plug_in, 2)
    (1.0, 1.0)
    """
    q, z = _checked(posteriors, states)
    own = np.log2(np.maximum(q[np.arange(z.size), z], _SMALLEST))
    spread = -(q * np.log2(np.maximum(q, _SMALLEST))).sum(axis=1)
    prior = state_entropy_bits(z, q.shape[1])
    return Information(prior + float(own.mean()), prior - float(spread.mean()))


def state_entropy_bits(states: ArrayLike, count: int) -> float:
    r"""Return the entropy of labels, its small-sample bias added back, at most log2 of their number.

    .. math:: \hat H = \min\Big(-\sum_k \hat p_k \log_2 \hat p_k + \frac{K_+ - 1}{2 n \ln 2},\; \log_2 K\Big)

    with K_+ the labels that occur.

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


def nearest_neighbour_information_bits(features: ArrayLike, states: ArrayLike, neighbours: int = 3) -> float:
    r"""Estimate I(z; x) from distances alone, without a classifier.

    .. math:: \hat I = \psi(n) + \psi(k) - \overline{\psi(n_{z_i})} - \overline{\psi(m_i)},

    with n_z windows of the state of i and m_i windows of any state within the distance of the k-th neighbour
    of its own state. Consistent, with a bias downward that grows with the dimension: reduce features to a few
    components first. Distances are the largest difference of any component, so bring those to one scale.

    Parameters
    ----------
    features : array_like, shape (n, d)
        Continuous values.
    states : array_like of int, shape (n,)
        True states; those with no more than `neighbours` windows are left out.
    neighbours : int
        k >= 1.

    Returns
    -------
    float
        Bits; may be below zero by chance.

    Raises
    ------
    InvalidArgumentError
        If shapes differ or no state has enough windows.

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
    from scipy.spatial import cKDTree
    from scipy.special import digamma

    x = finite_array("features", features, (None, None))
    z = np.asarray(states)
    check_shape("states", z.shape, (len(x),))
    k = int(in_range("neighbours", neighbours, 1, 1000))
    names, counts = np.unique(z, return_counts=True)
    kept = np.isin(z, names[counts > k])
    x, z = x[kept], z[kept]
    if not z.size:
        raise InvalidArgumentError(f"states: expected more than {k} windows of some state")
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

    It is a statement on all detectors only with an I that is not below the true one: from the lower bound of
    `information_from_posteriors` it becomes an estimate. With H of two bits and less it is often void; see
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

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    References
    ----------
    "Evidence of Absence", proposition 1, part (i).

    Examples
    --------
    >>> fano_bound(entropy=2.0, information=0.2, states=4)
    0.4
    """
    h, i, k = _fano_numbers(entropy, information, states)
    return min(max((h - i - 1.0) / math.log2(k), 0.0), 1.0)


def sharp_fano_bound(entropy: float, information: float, states: int) -> float:
    r"""Return the smallest error probability that Fano's inequality allows, without loosening it.

    .. math:: h(P_e) + P_e \log_2 (K - 1) \ge H(z) - I(z; x),

    with the binary entropy h, solved for the smallest P_e. Never below `fano_bound`, and attained by the
    symmetric channel.

    Errors are those of `fano_bound`.

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
    from scipy.optimize import brentq

    h, i, k = _fano_numbers(entropy, information, states)
    remaining, largest = h - i, (k - 1.0) / k
    if remaining <= 0.0:
        return 0.0
    if remaining >= math.log2(k) - 1e-12:
        return largest
    return float(brentq(lambda p: _fano_function(p, k) - remaining, 0.0, largest))


def _fano_numbers(entropy: float, information: float, states: int) -> tuple[float, float, int]:
    k = int(in_range("states", states, 2, 1_000_000))
    h = in_range("entropy", entropy, 0.0, math.log2(k) + 1e-9)
    return h, max(in_range("information", information, -math.inf, math.inf), 0.0), k


def _fano_function(error: float, states: int) -> float:
    spread = 0.0
    for p in (error, 1.0 - error):
        spread -= p * math.log2(p) if p > 0.0 else 0.0
    return spread + error * math.log2(states - 1) if states > 2 else spread


def _distribution(name: str, values: FloatArray) -> FloatArray:
    if not values.size or (values < 0.0).any() or not math.isclose(float(values.sum()), 1.0, abs_tol=1e-6):
        raise InvalidArgumentError(f"{name}: expected probabilities that sum to one")
    return values


def _checked(posteriors: ArrayLike, states: ArrayLike) -> tuple[FloatArray, IndexArray]:
    q = finite_array("posteriors", posteriors, (None, None))
    z = np.asarray(states)
    check_shape("states", z.shape, (len(q),))
    if not z.size or (q < 0.0).any() or not np.allclose(q.sum(axis=1), 1.0, atol=1e-6):
        raise InvalidArgumentError("posteriors: expected at least one row, each of them a distribution")
    if z.dtype.kind not in "iu" or z.min() < 0 or z.max() >= q.shape[1]:
        raise InvalidArgumentError(f"states: expected integers from 0 to {q.shape[1] - 1}")
    return q, z.astype(np.intp)
