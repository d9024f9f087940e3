"""The roof array of OVAD: where its 56 microphones are."""

import numpy as np

from .microphone_array import MicrophoneArray

# (y, z) in metres, in the order of OVAD's channels; x is zero. Facts released with Schulz et al. 2021, there
# in axes that grow to the right and up; no digit is rounded.
# fmt: off
_LEFT_UP_M = (
    (0.392, 0.288), (0.289024, 0.328443), (0.303659, 0.217809), (0.212195, 0.258831), (0.392, 0.128308),
    (0.32561, 0.063668), (0.247117, 0.148328), (0.17439, 0.109539), (0.084146, 0.312283),
    (0.123229, 0.23465), (0.087, 0.141538), (0.013415, 0.167385), (0.036, 0.06232), (-0.036, 0.06232),
    (-0.070732, 0.323471), (-0.015156, 0.250456), (-0.14, 0.216514), (-0.082927, 0.139077),
    (-0.207317, 0.274991), (-0.29878, 0.287422), (-0.291463, 0.176788), (-0.392, 0.210462),
    (-0.19878, 0.118154), (-0.15, 0.051237), (-0.292683, 0.067397), (-0.392, 0.027077),
    (-0.247561, -0.046769), (-0.317073, -0.089231), (-0.392, -0.152634), (-0.276829, -0.201108),
    (-0.392, -0.316308), (-0.303659, -0.320443), (-0.150906, -0.18845), (-0.02439, -0.175003),
    (-0.206098, -0.273206), (-0.103659, -0.322929), (-0.026359, -0.260182), (0.048996, -0.309255),
    (0.087801, -0.198622), (0.179901, -0.218845), (0.253048, -0.178723), (0.230488, -0.312985),
    (0.392, -0.248615), (0.314634, -0.27072), (0.392, -0.049452), (0.320732, -0.116578), (0.252, -0.018349),
    (0.190667, -0.097859), (0.158537, 0.023385), (0.072, 0.0), (-0.072, 0.0), (-0.162195, -0.069342),
    (-0.036, -0.06232), (-0.090244, -0.108308), (0.036, -0.06232), (0.102439, -0.104124),
)
# fmt: on


def ovad_array() -> MicrophoneArray:
    """Return the array that OVAD was recorded with: 56 microphones in the y-z plane, across the vehicle.

    Its positions were released with Schulz et al., "Hearing What You Cannot See: Acoustic Vehicle Detection
    Around Corners", 2021. It is the default wherever a recording in OVAD's layout names no array of its own,
    and what the simulator listens with.

    Returns
    -------
    MicrophoneArray
        In the order of OVAD's channels; the same each time.

    Examples
    --------
    >>> array = ovad_array()
    >>> array.n_microphones, array.aperture_m.round(3).tolist(), round(array.horizontal_moment_m2, 3)
    (56, [0.0, 0.784, 0.651], 3.027)
    """
    y, z = np.array(_LEFT_UP_M).T
    return MicrophoneArray(np.stack([np.zeros_like(y), y, z], axis=1), "OVAD (Schulz et al. 2021)")
