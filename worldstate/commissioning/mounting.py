"""Arrays that are not where the front-end believes them: turned, or each microphone a little off."""

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray

# What a bracket and a tape measure leave: two degrees are 14 mm over the width of 40 cm.
YAW_DEG, POSITION_MM = 2.0, 5.0


def mountings(array: MicrophoneArray, rng: np.random.Generator) -> dict[str, MicrophoneArray]:
    """Return what an array may be believed to be: itself, turned, or with every coordinate a little off.

    Examples
    --------
    >>> found = mountings(MicrophoneArray([[0, 1, 0], [0, -1, 0]]), np.random.default_rng(1))
    >>> {name: one.positions_m[0, :2].round(2).tolist() for name, one in found.items()}
    {'as mounted': [0.0, 1.0], '2 deg of yaw': [-0.03, 1.0], '5 mm of position': [0.0, 1.0]}
    """
    cosine, sine = np.cos(np.radians(YAW_DEG)), np.sin(np.radians(YAW_DEG))
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    off = 1e-3 * POSITION_MM * rng.standard_normal(array.positions_m.shape)
    return {
        "as mounted": array,
        f"{YAW_DEG:g} deg of yaw": MicrophoneArray(array.positions_m @ turn.T),
        f"{POSITION_MM:g} mm of position": MicrophoneArray(array.positions_m + off),
    }
