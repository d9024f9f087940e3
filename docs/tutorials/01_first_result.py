"""A first result: push sound into a listener and print when an advisory begins."""

import numpy as np

from worldstate import Listener
from worldstate.frontend import ovad_array
from worldstate.simulation import SimulationSettings, simulate_recording, site

street = SimulationSettings(site("SA1"), "left", entry_s=7.0, sample_rate_hz=6000.0)
sound = simulate_recording(street, np.random.default_rng(1)).audio  # 10 s of 56 microphones
listener = Listener(ovad_array(), street.sample_rate_hz)
states = [state for block in np.array_split(sound, 1000) for state in listener.push(block)]
for state in states:
    for cue in state.cues:
        if cue.began:
            print(f"{state.time_s:.1f} s: advisory {cue.direction}, risk {cue.risk:.2f}")

# The figure: the same street with and without a vehicle.
from dataclasses import replace

from tutorial_figures import draw_sides, tutorial_figure

empty = simulate_recording(replace(street, approach="none"), np.random.default_rng(1)).audio
with tutorial_figure(__file__, 8.0, 3.2) as figure:
    comes, none = figure.subplots(1, 2, sharey=True)
    draw_sides(comes, states, street.entry_s)
    draw_sides(none, Listener(ovad_array(), street.sample_rate_hz).push(empty))
    comes.set(title="a vehicle from the left", ylabel="chance to come into view within 3 s")
    none.set(title="no vehicle")
    figure.supxlabel("time, s", fontsize=10)
    comes.legend(loc="upper left")
