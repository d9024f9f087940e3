"""Another modality: the light of headlights on a wall as evidence for a hidden vehicle."""

import numpy as np

from worldstate import Measurement, NotUsable, SignatureEvidence, Unqueried, WorldFilter

# The wall is brighter by 4 +- 1 units if a vehicle is hidden on the left, and by 0 +- 1 otherwise.
world, states, no_sound = WorldFilter(), [], NotUsable("a camera for light measures no sound")
for hop, noise in enumerate(np.random.default_rng(5).normal(size=40).tolist()):
    brighter = noise + (4.0 if 10 <= hop < 25 else 0.0)
    hidden, other = -0.5 * (brighter - 4.0) ** 2, -0.5 * brighter**2
    light = SignatureEvidence(("left", "right"), hidden=(hidden, other), visible=other, none=other)
    stamp_ns = world.state.stamp_ns + 100_000_000
    world = world.update(Measurement(stamp_ns, light, Unqueried("no camera"), no_sound, no_sound))
    states.append(world.state)
for state in states[3::5]:
    print(f"{state.time_s:.1f} s:", *(f"risk {cue.direction} {cue.risk:.2f}" for cue in state.cues))

# The figure: the risk of both sides while the wall is bright.
from tutorial_figures import draw_sides, tutorial_figure

with tutorial_figure(__file__, 8.0, 3.2) as figure:
    axes = figure.subplots()
    axes.axvspan(1.05, 2.55, color="whitesmoke", label="the wall is bright")
    draw_sides(axes, states, read=lambda cue: cue.risk)
    axes.set(xlabel="time, s", ylabel="risk")
    axes.legend(loc="upper right")
