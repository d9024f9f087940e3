"""Fisher information of several modalities, with independent noise and with a common cause."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

_SLACK = 1e-9


def combined_information(parts: Sequence[ArrayLike]) -> FloatArray:
    r"""Return :math:`J = \sum_m J_m`, which independent noise given the state (A1) allows, shape (p, p).

    Parameters
    ----------
    parts : sequence of array_like, each of shape (p, p)
        Symmetric, positive semi-definite.

    Returns
    -------
    ndarray, shape (p, p)
        J.

    Raises
    ------
    InvalidArgumentError
        If there is none, shapes differ or one is no information matrix.

    References
    ----------
    "Evidence of Absence", proposition 1, part (ii).

    Examples
    --------
    >>> combined_information([[[4.0, 0.0], [0.0, 0.0]], [[1.0, 0.0], [0.0, 9.0]]])
    array([[5., 0.],
           [0., 9.]])
    """
    if not len(parts):
        raise InvalidArgumentError("parts: expected at least one information matrix")
    first = _information("parts", parts[0])
    return np.asarray(sum((_information("parts", part, first.shape) for part in parts[1:]), first))


def gaussian_information(slope: ArrayLike, covariance: ArrayLike) -> FloatArray:
    r"""Return the information of an observation with Gaussian noise of known covariance.

    .. math:: J = H^T R^{-1} H

    Parameters
    ----------
    slope : array_like, shape (n, p)
        H, derivative of the mean observation by the state.
    covariance : array_like, shape (n, n)
        R, positive definite.

    Returns
    -------
    ndarray, shape (p, p)
        J.

    Raises
    ------
    InvalidArgumentError
        If shapes do not fit or R is not positive definite.

    References
    ----------
    S. M. Kay, *Fundamentals of Statistical Signal Processing: Estimation Theory*, 1993, chapter 3.

    Examples
    --------
    >>> gaussian_information([[1.0], [1.0]], [[1.0, 0.5], [0.5, 1.0]]).round(3)
    array([[1.333]])
    """
    H = finite_array("slope", slope, (None, None))
    R = _symmetric("covariance", covariance, (len(H), len(H)))
    try:
        whitened = np.linalg.solve(np.linalg.cholesky(R), H)
    except np.linalg.LinAlgError as error:
        raise InvalidArgumentError("covariance: expected a positive definite matrix") from error
    return np.asarray(whitened.T @ whitened)


def common_cause_information(
    slopes: Sequence[ArrayLike], covariances: Sequence[ArrayLike], effects: Sequence[ArrayLike]
) -> FloatArray:
    r"""Return the information of modalities that a common disturbance reaches: (A1) fails.

    Rain soils the lens and raises the noise of the microphones. With a disturbance w of unit variance that
    moves the observation of modality m by :math:`g_m w`,

    .. math:: R = \mathrm{blkdiag}(R_1, \dots) + g g^T, \qquad J = H^T R^{-1} H.

    Each modality alone has :math:`R_m + g_m g_m^T`. Where the disturbance moves all of them as the state
    would, J is below the sum of what each has alone, and a fusion that adds them is too sure of itself (see
    `claimed_covariance`). Where it moves them against each other, one channel tells the disturbance in the
    other and J is above the sum.

    Shapes: slopes (n_m, p), covariances (n_m, n_m), effects (n_m,).

    Examples
    --------
    >>> one = ([[1.0]], [[1.0]])
    >>> common_cause_information([one[0]] * 2, [one[1]] * 2, [[1.0], [1.0]]).round(3)
    array([[0.667]])
    >>> alone = gaussian_information([[1.0]], [[2.0]])
    >>> combined_information([alone, alone])
    array([[1.]])
    """
    H, R = _stacked(slopes, covariances, effects)
    return gaussian_information(H, R)


def claimed_covariance(
    slopes: Sequence[ArrayLike], covariances: Sequence[ArrayLike], effects: Sequence[ArrayLike]
) -> tuple[FloatArray, FloatArray]:
    r"""Return what a fusion that assumes (A1) claims, and what it has, when the noise has a common cause.

    .. math:: P_{claimed} = J_s^{-1}, \qquad P_{true} = J_s^{-1} (J_s + C)\, J_s^{-1}, \qquad
              C = \sum_{m \ne l} H_m^T S_m^{-1} g_m g_l^T S_l^{-1} H_l,

    with :math:`S_m = R_m + g_m g_m^T` and :math:`J_s = \sum_m H_m^T S_m^{-1} H_m`.

    Shapes: returns (p, p).

    References
    ----------
    P. J. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967 (the
    covariance under a wrong model).

    Examples
    --------
    >>> claimed, true = claimed_covariance([[[1.0]]] * 2, [[[1.0]]] * 2, [[1.0]] * 2)
    >>> claimed.round(3), true.round(3)
    (array([[1.]]), array([[1.5]]))
    """
    # Errors are those of `common_cause_information`; also if the sum is singular.
    H, R = _stacked(slopes, covariances, effects)
    blocks = np.zeros_like(R)
    start = 0
    for slope in slopes:
        end = start + len(np.asarray(slope))
        blocks[start:end, start:end] = np.linalg.inv(R[start:end, start:end])
        start = end
    added = H.T @ blocks @ H
    if np.linalg.matrix_rank(added) < len(added):
        raise InvalidArgumentError("slopes: expected modalities that together observe the whole state")
    claimed = np.asarray(np.linalg.inv(added))
    gain = claimed @ H.T @ blocks
    return claimed, np.asarray(gain @ R @ gain.T)


def at_least(larger: ArrayLike, smaller: ArrayLike) -> bool:
    r"""Tell whether one information matrix is at least the other in the Loewner order.

    .. math:: \lambda_{min}(J_1 - J_2) \ge 0

    Shapes: larger, smaller (p, p).

    Examples
    --------
    >>> at_least([[2.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, 1.0]])
    True
    >>> at_least([[2.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, 1.5]])
    False
    """
    difference = np.asarray(larger, dtype=np.float64) - np.asarray(smaller, dtype=np.float64)
    scale = max(float(np.abs(np.asarray(larger)).max()), 1.0)
    return bool(np.linalg.eigvalsh(difference)[0] >= -_SLACK * scale)


def _stacked(
    slopes: Sequence[ArrayLike], covariances: Sequence[ArrayLike], effects: Sequence[ArrayLike]
) -> tuple[FloatArray, FloatArray]:
    if not len(slopes) == len(covariances) == len(effects) or not len(slopes):
        raise InvalidArgumentError("slopes, covariances, effects: expected one of each for every modality")
    H = [finite_array("slopes", slope, (None, None)) for slope in slopes]
    g = [finite_array("effects", effect, (len(h),)) for effect, h in zip(effects, H, strict=True)]
    R = np.outer(np.concatenate(g), np.concatenate(g))
    start = 0
    for h, covariance in zip(H, covariances, strict=True):
        end = start + len(h)
        R[start:end, start:end] += _symmetric("covariances", covariance, (len(h), len(h)))
        start = end
    if len({h.shape[1] for h in H}) != 1:
        raise InvalidArgumentError("slopes: expected the same state in every modality")
    return np.concatenate(H), R


def _information(name: str, value: ArrayLike, shape: tuple[int, ...] | None = None) -> FloatArray:
    J = _symmetric(name, value, shape or (None, None))
    if np.linalg.eigvalsh(J)[0] < -_SLACK * max(float(np.abs(J).max()), 1.0):
        raise InvalidArgumentError(f"{name}: expected a positive semi-definite matrix")
    return J


def _symmetric(name: str, value: ArrayLike, shape: Sequence[int | None]) -> FloatArray:
    matrix = finite_array(name, value, shape)
    if matrix.shape[0] != matrix.shape[1] or not matrix.size or not np.allclose(matrix, matrix.T):
        raise InvalidArgumentError(f"{name}: expected a symmetric matrix, got shape {matrix.shape}")
    return matrix
