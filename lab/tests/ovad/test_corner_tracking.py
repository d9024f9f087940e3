"""Properties of tracks at a corner: on artificial recordings, and on the real ones if they are available.

OVAD_SEQUENCES is the folder of the real recordings, by default beside the repository.
"""

import json
import os
from dataclasses import dataclass, replace
from functools import reduce
from operator import getitem
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_up_corner import write_corner
from worldstate_lab.sequences.hearing import Chain, ovad_chain
from worldstate_lab.sequences.recordings import TRUTH, read_recordings
from worldstate_lab.sequences.tracking import OC_SORT, WORLD, tracked, tracking_figures
from worldstate_lab.trials.listening import likely_movers

from worldstate.adapters import read_array, read_model
from worldstate.state import Entity

SEQUENCES = Path(os.environ.get("OVAD_SEQUENCES") or Path(__file__).parents[4] / "shared" / "ovad-sequences")
# GOSPA at 60 degrees for one vehicle without a track.
MISS_DEG = 30.0


def figures(found):
    return tracking_figures(found, np.random.default_rng(0))


def believed_s(chain, recording):
    """Return the times at which vehicles are believed hidden and in view, in seconds."""
    found = {"hidden": [], "visible": [], "emerged": []}
    for step in chain.steps(recording):
        for one in likely_movers(step.state):
            found[one.status].append(step.state.stamp_ns * 1e-9)
    return found


@dataclass(frozen=True, slots=True)
class Scripted(Chain):
    """A chain with given entities: one named "same" in view, and before it a hidden one or none."""

    hidden: str | None = None

    def steps(self, recording):
        for step in Chain.steps(self, recording):
            state, at_ns = step.state, step.state.stamp_ns
            if at_ns * 1e-9 > recording.t0_s - 0.05:
                entities = [replace(one, id="same") for one in state.entities]
            else:
                ids = [self.hidden] * (self.hidden is not None)
                told = "hidden", 0.9, 0.9, 0.8, 0.3, at_ns, at_ns
                entities = [Entity(one, *told, direction=recording.side) for one in ids]
            yield SimpleNamespace(
                frame=step.frame, measurement=step.measurement, state=replace(state, entities=tuple(entities))
            )


# Four vehicles in view for a second each, and two streets without one; at SB1 a car is parked.
@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corner") / "made-up"
    return read_recordings(write_corner(folder, np.random.default_rng(0), approaches=4, hazard_free=2))


@pytest.fixture(scope="module")
def chain():
    return ovad_chain(read_model(None))


@pytest.fixture(scope="module")
def approaches(chain, recordings):
    return [tracked(chain, one) for one in recordings if not one.hazard_free]


def test_an_empty_street_has_no_vehicle_and_no_vehicle_is_in_view_before_t0(chain, recordings):
    for one in recordings[-2:]:
        assert not any(believed_s(chain, one).values())
    assert min(believed_s(chain, recordings[1])["visible"]) > recordings[1].t0_s - 0.05


def test_a_vehicle_in_view_is_an_entity_on_its_side_within_a_tenth_of_a_second(approaches):
    for one in approaches:
        assert one.delay_s < 0.15
        assert one.side == one.recording.side
    found = json.loads(json.dumps(figures(approaches), allow_nan=False))
    assert found["hand_over_delay_s"] < 0.15
    for name in ("identity", "bearing", "gospa_deg"):
        assert set(found["tracking"][name]) == {"all", "SA1", "SB1"}


def test_a_bearing_in_view_is_that_of_the_vehicle_and_does_not_use_the_camera(chain, approaches):
    found = figures(approaches)["tracking"]["bearing"]["all"]
    # The vehicle moves by 3 degrees between images.
    assert found["median_deg"] < 3.0
    assert found["nees_mean"] < 1.0
    assert min(found["images_later_s"].items(), key=lambda one: one[1])[0] in ("0", "0.1")
    recording = approaches[0].recording
    pairs = zip(chain.steps(recording), replace(chain, boxes=None).steps(recording), strict=True)
    assert all(seen.measurement.bearing == alone.measurement.bearing for seen, alone in pairs)


def test_tracks_continue_through_withheld_images(approaches):
    found = figures(approaches)["tracking"]["gospa_deg"]["all"]
    assert found[WORLD]["total"] < 0.2 * MISS_DEG
    # It links boxes by their overlap, which is too small after 0.2 s here.
    assert found[WORLD]["total"] < found[OC_SORT]["total"] <= MISS_DEG + 1e-9


@pytest.mark.parametrize(
    ("hidden", "expected"), [("same", "kept"), ("other", "another"), (None, "none hidden")]
)
def test_identity_is_that_of_the_hidden_entity(chain, recordings, hidden, expected):
    scripted = Scripted(chain.path, chain.model, chain.array, hidden=hidden)
    assert tracked(scripted, recordings[0]).identity == expected


@pytest.fixture(scope="module", params=["seven", "pair"])
def real(request):
    """The chain of one path, the real recordings, and the figures of their approaches."""
    if not (SEQUENCES / TRUTH).is_file():
        pytest.skip(f"no real recordings in {SEQUENCES.name}: set OVAD_SEQUENCES")
    path = ovad_chain(read_model(None))
    if request.param == "pair":
        pair = SEQUENCES / "pair"
        if not (pair / "model.json").is_file():
            pytest.skip("no model for two microphones beside the recordings")
        path = Chain("pair", read_model(pair / "model.json"), read_array(pair / "array.csv"))
    every = read_recordings(SEQUENCES)
    return path, every, figures([tracked(path, one) for one in every if not one.hazard_free])


# Limits that a defect would violate. Comments give the values on the 45 recordings: seven microphones, two
# microphones.
LIMITS = [
    ("identity/all/kept", 0.19, 1.0),  # 10 and 9 of 23; the lower ends of the intervals are 0.23 and 0.20
    ("identity/all/no box", 0, 0),
    ("hand_over/found", 0.85, 1.0),  # All, with a median of 0.0 s and a 90 % quantile of 0.1 s, on both paths
    ("hand_over/median_s", 0.0, 0.15),
    ("hand_over/late_s", 0.0, 0.35),
    ("hand_over/right_side", 0.85, 1.0),  # All are right on both paths
    ("before_t0/stated", 0.3, 1.0),  # 13 and 10 of 23 approaches
    ("before_t0/time_error_s", 0.0, 1.5),  # 0.67 and 0.91 s
    ("before_t0/time_coverage", 0.75, 1.0),  # 0.97 and 0.93 for a nominal 0.9
    ("bearing/all/median_deg", 0.0, 15.0),  # 11.6 and 6.4 degrees
    ("bearing/all/nees_mean", 0.0, 3.0),  # 1.3 and 0.5
    (f"gospa_deg/all/{WORLD}/total", 0.0, 20.0),  # 13.8 and 14.1; OC-SORT 21.8
]


@pytest.mark.long
def test_figures_of_real_vehicles_are_within_their_limits(real):
    path, every, found = real
    tracking = found["tracking"]
    apart = {at: reduce(getitem, at.split("/"), tracking) for at, *_ in LIMITS}
    assert {at: apart[at] for at, low, high in LIMITS if not low <= apart[at] <= high} == {}
    # 3.3 degrees with seven microphones half a second later, because the rows of their spectra are early
    assert min(tracking["bearing"]["all"]["images_later_s"].values()) < 8.0
    gospa_deg = tracking["gospa_deg"]["all"]  # Every second image is withheld
    assert gospa_deg[WORLD]["total"] < gospa_deg[OC_SORT]["total"]
    calm = [one for one in every if one.hazard_free][::4]
    empty = [believed_s(path, one) for one in calm]
    # Of the snapshots of all 22, 0.05 contain a vehicle in view by the camera, 0.003 a hidden one.
    assert np.sum([len(one["visible"]) for one in empty]) < 0.2 * 90 * len(calm)
    assert np.sum([len(one["hidden"]) for one in empty]) < 0.05 * 90 * len(calm)
