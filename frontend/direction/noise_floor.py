r"""Peak-to-median ratio that the SRP of an array reaches without a source.

Sound that comes from all horizontal directions alike is the noise of a street whose spectrum is least flat:

.. math:: D(\theta) = \frac{1}{K} \sum_k d_k(\theta), \qquad
          d_k(\theta) = \Big\langle \frac{|a_k(\theta)^H a_k(\phi)|^2}{M^2} \Big\rangle_\phi

After the phase transform the power of a beam in a frame and bin is about exponentially distributed, so that
the mean over T frames and K bins scatters by

.. math:: \epsilon = \max_\theta \frac{\sqrt{\sum_k d_k^2(\theta)}}{\sqrt{T} \sum_k d_k(\theta)}.
"""

from collections.abc import Sequence

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering
from worldstate.ground.typing import Complex64Array, FloatArray

# What three deviations reach in all directions together is called noise only up to this share of its excess:
# a vehicle in view, heard by 4 microphones, has a lower peak in a quarter of the hops, and a bearing of
# noise that is let through states 50 degrees, for it has many peaks.
_DEVIATIONS, _SHARE = 3.0, 0.6
_ALL_ROUND_RAD = np.radians(np.arange(-180.0, 180.0, 10.0))


def noise_prominence(
    rows: Sequence[Steering],
    array: MicrophoneArray,
    frequencies_hz: FloatArray,
    n_frames: float,
    speed_of_sound_m_s: float,
) -> float:
    r"""Return the peak-to-median ratio up to which a peak is taken for noise.

    .. math:: \rho_0 = 1 + 0.6 \Big( (1 + 3 \epsilon)\, \frac{\max_\theta D}{\mathrm{med}_\theta D} - 1 \Big)
    """
    horizon = array.steering(frequencies_hz, _ALL_ROUND_RAD, 0.0, speed_of_sound_m_s).astype(np.complex64)
    by_row = np.array([_heard(row, horizon) for row in rows])
    diffuse = by_row.mean(axis=1).max(axis=0)
    # Of the last row: rows differ little in how their bins share the power.
    scatter = np.linalg.norm(by_row[-1], axis=0) / (np.sqrt(n_frames) * by_row[-1].sum(axis=0))
    reached = diffuse.max() / np.median(diffuse) * (1.0 + _DEVIATIONS * scatter.max())
    return float(1.0 + _SHARE * (reached - 1.0))


def _heard(row: Steering, waves: Complex64Array) -> FloatArray:
    """Return the mean power per bin and beam of plane waves (bins, M, waves), up to a factor."""
    return np.asarray(row.power_within(waves) / waves.shape[2])
