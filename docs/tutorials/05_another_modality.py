"""Another modality: headlights on a wall as evidence for a hidden vehicle."""

from worldstate import Measurement, NotUsable, SignatureEvidence, Unqueried, WorldFilter

# Nats: the wall is brighter by 3 +- 1 with a hidden vehicle on the left, else by 0 +- 1.
world, states, no_sound = WorldFilter(), [], NotUsable("not measured by light")
for brighter in (0.1, -0.4, 1.2, 2.6, 3.3, 2.9, 3.4, 2.7, 3.1, 2.8, 0.3, -0.2, 0.1, 0.4, -0.3):
    hidden, other = -0.5 * (brighter - 3.0) ** 2, -0.5 * brighter**2
    light = SignatureEvidence(("left", "right"), hidden=(hidden, other), visible=other, none=other)
    stamp_ns = world.state.stamp_ns + 100_000_000
    world = world.update(Measurement(stamp_ns, light, Unqueried("no camera"), no_sound, no_sound))
    states.append(world.state)
for state in states[1::3]:
    print(f"{state.stamp_ns / 1e9:.1f} s:", *(f"risk {cue.direction} {cue.risk:.2f}" for cue in state.cues))

# The figure: the risk of both sides while the wall is bright.
from tutorial_figures import draw_sides, tutorial_figure

with tutorial_figure(__file__, 8.0, 3.2) as figure:
    axes = figure.subplots()
    axes.axvspan(0.35, 1.05, color="whitesmoke", label="the wall is bright")
    draw_sides(axes, states, read=lambda cue: cue.risk)
    axes.set(xlabel="time, s", ylabel="risk")
    axes.legend(loc="upper right")
