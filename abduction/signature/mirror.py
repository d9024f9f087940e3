"""The mirror image of a feature vector: what the same scene with its sides exchanged would give."""

from worldstate.ground.typing import FloatArray

SEGMENTS = 2


def mirror_features(X: FloatArray, segments: int = SEGMENTS) -> FloatArray:
    r"""Return the features of the mirrored scene: azimuths reversed within each segment.

    .. math:: \bar x_{s,a} = x_{s, A - 1 - a}

    Parameters
    ----------
    X : ndarray, shape (n, segments * azimuths)
        Segment-major: all azimuths of the first segment, then those of the next.
    segments : int
        Stretches of time that a feature vector covers.

    Returns
    -------
    ndarray, shape of `X`
        A copy.

    References
    ----------
    From the definition: azimuths are evenly spaced about straight ahead.

    Examples
    --------
    >>> import numpy as np
    >>> mirror_features(np.array([[1, 2, 3, 4, 5, 6]]))
    array([[3, 2, 1, 6, 5, 4]])
    """
    return X.reshape(len(X), segments, -1)[:, :, ::-1].reshape(X.shape)
