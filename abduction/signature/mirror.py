"""Mirror image of a feature vector: the feature of the same scene with left and right exchanged."""

from worldstate.ground.typing import FloatArray

SEGMENTS = 2


def mirror_features(X: FloatArray, segments: int = SEGMENTS) -> FloatArray:
    r"""Return the features of the mirrored scene: azimuths reversed within each segment.

    .. math:: \bar x_{s,a} = x_{s, A - 1 - a}

    Shapes: X (n, segments * azimuths).
    """
    return X.reshape(len(X), segments, -1)[:, :, ::-1].reshape(X.shape)
