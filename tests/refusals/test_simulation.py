"""Errors of the simulator for settings that are wrong: one row per error."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InvalidArgumentError
from worldstate.simulation import (
    DatasetSettings,
    SimulationSettings,
    SoundSettings,
    draw_settings,
    place,
    simulate_recording,
    site,
)
from worldstate.simulation.scene.kinds import vehicle_kind
from worldstate.simulation.scene.occluders import OccludingBody
from worldstate.simulation.scene.settings import sound_kind
from worldstate.simulation.stream.settings import StreamSettings, Traffic

STREET = site("SA1")
STREAM = StreamSettings(STREET, 1.0)
RNG = np.random.default_rng(0)


def _scene(**change: object) -> Callable[[], object]:
    return lambda: SimulationSettings(**{"site": STREET, "approach": "left", **change})


def _data_set(**change: object) -> Callable[[], object]:
    return lambda: DatasetSettings(**change)


def _sound(**change: object) -> Callable[[], object]:
    return lambda: SoundSettings(**change)


REFUSALS: dict[str, tuple[Callable[[], object], str]] = {
    "unknown vehicle": (lambda: vehicle_kind("nowhere"), "nowhere"),
    "unknown place": (lambda: place("nowhere"), "nowhere"),
    "unknown site": (lambda: site("nowhere"), "nowhere"),
    "unknown sound": (lambda: sound_kind("vuvuzela"), "vuvuzela"),
    "outline of one corner": (lambda: OccludingBody(((0.0, 1.0),)), "corners_m"),
    "outline of 17 corners": (lambda: OccludingBody(tuple((float(i), 1.0) for i in range(17))), "corners_m"),
    "outline that is no number": (lambda: OccludingBody(((0.0, np.nan),) * 2), "corners_m"),
    "sound of an unknown kind": (_sound(kind="vuvuzela"), "vuvuzela"),
    "gusts without channels": (_sound(kind="gusts"), "channels"),
    "voice of no duration": (_sound(kind="voice", duration_s=0.0), "duration_s"),
    "voice too far away": (_sound(kind="voice", place_m=(1e4, 0.0)), "place_m"),
    "route of one point": (_sound(kind="steps", route_m=((5.0, 0.0),)), "route_m"),
    "recording too short": (_scene(duration_s=0.1), "duration_s"),
    "recording without a duration": (_scene(duration_s=float("nan")), "duration_s"),
    "vehicle that stands": (_scene(speed_mps=0.0), "speed_mps"),
    "approach from above": (_scene(approach="above"), "approach"),
    "entry after the end": (_scene(entry_s=11.0), "entry_s"),
    "approach that the place lacks": (lambda: draw_settings("SM1", "right", RNG), "approach"),
    "microphone below the road": (
        lambda: simulate_recording(
            SimulationSettings(STREET, "none", duration_s=0.5), RNG,
            MicrophoneArray([[0.0, 0.1, 0.0], [0.0, -0.1, 3.6]])), r"1\.80 m below"),
    "data set without recordings": (_data_set(n_static=0), "n_static"),
    "data set with a negative count": (_data_set(n_dynamic=-1), "n_dynamic"),
    "data set of an unknown scene": (_data_set(scene="tunnel"), "scene"),
    "data set of horses": (_data_set(kind="horse"), "kind"),
    "drive at a merge": (_data_set(scene="merge", n_dynamic=1), "n_dynamic"),
    "video of a drive": (_data_set(n_dynamic=1, video=True), "video"),
    "background limits out of order": (lambda: Traffic("t", {}, background_db=(3.0, 2.0)), "background_db"),
    "rain share above one": (lambda: Traffic("t", {}, rain_share=1.5), "rain_share"),
    "unknown flow": (lambda: Traffic("t", {"up": 3.0}), "per_hour"),
    "drive of wrong duration": (lambda: StreamSettings(site("DA1"), 1.1), "minutes"),
    "stream at a merge": (lambda: StreamSettings(place("merge").site, 1.0), "junction"),
    "stream too long": (lambda: replace(STREAM, minutes=1000.0), "minutes"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSALS)
def test_refuses(case: str) -> None:
    call, words = REFUSALS[case]
    with pytest.raises(InvalidArgumentError, match=words):
        call()
