"""Embed it in a stack: a process ends, and another one continues from its checkpoint at the next sample."""

import numpy as np

from worldstate import Listener
from worldstate.frontend import ovad_array
from worldstate.simulation import SimulationSettings, simulate_recording, site

street = SimulationSettings(site("SA1"), "left", entry_s=7.0, sample_rate_hz=6000.0)
sound = simulate_recording(street, np.random.default_rng(1)).audio
first, last = np.split(sound, [27_000])  # the process ends at 4.5 s
listener = Listener(ovad_array(), 6000.0)
before = [state for block in np.array_split(first, 450) for state in listener.push(block)]
resumed = before + Listener(ovad_array(), 6000.0, resume=listener.checkpoint()).push(last)
print(f"{len(resumed)} states, equal to one process: {resumed == Listener(ovad_array(), 6000.0).push(sound)}")

# The figure: the second process with and without the checkpoint.
from tutorial_figures import draw_sides, tutorial_figure

with tutorial_figure(__file__, 8.0, 3.2) as figure:
    axes = figure.subplots(1, 2, sharey=True)
    draw_sides(axes[0], resumed, street.entry_s)
    draw_sides(axes[1], before, street.entry_s)
    draw_sides(axes[1], Listener(ovad_array(), 6000.0, start_s=4.5).push(last))
    for one, title in zip(axes, ("continued from the checkpoint", "started without it"), strict=True):
        one.axvspan(4.45, 4.55, color="lightgrey", label="the process ends")
        one.set(title=title)
    axes[0].set(ylabel="chance to come into view within 3 s")
    axes[0].legend(loc="upper left")
    figure.supxlabel("time, s", fontsize=10)
