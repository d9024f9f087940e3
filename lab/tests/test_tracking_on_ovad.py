"""What a user relies on, on recordings in OVAD's layout: simulated ones, or those that OVAD_ROOT names."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from worldstate_lab.methods.line_of_sight import seen_early_s
from worldstate_lab.trials.pass_cache import Hearer
from worldstate_lab.trials.trial import Take, find_takes

from worldstate.adapters.datasets.ovad import Recording
from worldstate.cli.main import main

# With OVAD_ROOT nobody asks for the smoke evaluation, so that its group is not found by itself.
pytestmark = [pytest.mark.xdist_group("smoke"), pytest.mark.long]

ROOT = os.environ.get("OVAD_ROOT")
LINE_OF_SIGHT = (
    "Vision-only",
    "Radar field-of-view model",
    "OC-SORT recovery (stock)",
    "OC-SORT recovery (coasting)",
)
# Table I of the paper: lead in seconds, share of approaches detected, false alarms an hour.
TABLE_ONE = {
    "published": (2.29, 1.00, 350.0),
    "published, sustained": (1.88, 0.88, 185.0),
    "proposed .02": (1.69, 0.88, 107.0),
    "proposed .05": (2.15, 0.93, 262.0),
}
UNCALIBRATED = ("published", "published, sustained")
OURS = ("shipped model", "+ site adaptation", "world-state advisory")


@pytest.fixture(scope="module")
def found(request, tmp_path_factory):
    """The rows of Table I, and what was heard of every recording."""
    if ROOT is None:
        out, report = request.getfixturevalue("smoke")
        root = out / "smoke"
    else:
        root, out = Path(ROOT), tmp_path_factory.mktemp("ovad")
        jobs = str(os.cpu_count() or 1)
        assert main(["evaluate", str(root), "--out", str(out), "--jobs", jobs]) == 0
        report = json.loads((out / "evaluation.json").read_text())
    hearing = Hearer(out / "cache")
    return report, [hearing(take) for take in find_takes(root).static]


@pytest.fixture(scope="module")
def rows(found):
    return found[0]["protocols"]["static"]


@pytest.fixture(scope="module")
def simulated(found):
    return "SIMULATED" in found[0]["data"]


@pytest.fixture(scope="module")
def approaches(found):
    return [trial for trial in found[1] if not trial.hazard_free]


@pytest.mark.parametrize("name", LINE_OF_SIGHT)
def test_what_needs_line_of_sight_warns_of_next_to_nothing_hidden(rows, name):
    """The paper's 0; 3 of its 42 approaches have a box before T0."""
    assert rows[name]["detection"] <= 0.15
    assert rows[name]["hazard_awareness"] > 0.5  # It sees what is in view


def test_boxes_before_sight_are_within_the_tolerance_of_the_annotation(approaches):
    assert (seen_early_s(approaches) > 0.0).mean() <= 0.15


def test_sound_warns_of_most_hidden_vehicles(rows, simulated):
    # A threshold set on a handful of recordings is whatever the loudest of them says: without those rows. Of
    # simulated streets the model that ships has heard none, and warns of six in ten.
    asked = UNCALIBRATED if simulated else (*UNCALIBRATED, *OURS)
    others = [row["detection"] for name, row in rows.items() if name in asked]
    assert len(others) == len(asked) and np.mean(others) >= 0.5


@pytest.mark.parametrize("name", [*TABLE_ONE, *OURS])
def test_rows_are_of_the_order_of_the_papers(rows, simulated, name):
    lead_s, detection, false_alarms = TABLE_ONE.get(name, TABLE_ONE["proposed .02"])
    row = rows[name]
    if row["detection"] > 0.0:
        assert lead_s / 10.0 < row["lead_s"] < 5.1
    # Of simulated streets a row stands on the handful of recordings that its threshold was set on.
    assert simulated or row["detection"] > 0.5 * detection
    assert row["false_alarms_per_hour"] < 10.0 * false_alarms
    # Or one alarm that never ends would be a good row.
    assert row["advisory_share"] < 0.5


@pytest.mark.slow
def test_who_was_heard_coming_is_who_comes(approaches, request, tmp_path):
    """The entity in view was there before T0 in most of the approaches that the world-state warned of."""
    heard = list(approaches)
    if ROOT is None:  # two approaches may both be missed
        demo = Recording.open(request.getfixturevalue("approach").folder)
        heard.append(Hearer(tmp_path)(Take.of(demo)))
    warned = [trial for trial in heard if trial.chains["filtered"].alarm[trial.hops.before_sight()].any()]
    assert warned
    assert np.mean([_kept(trial) for trial in warned]) > 0.5


def _kept(trial):
    """Whether the track that is nearest to the vehicle, in most images of it, began before T0."""
    tracks, nearest = trial.chains["filtered"].tracks, []
    seen = trial.truth.in_view.astype(bool) & (trial.truth.vehicle == 0)
    for time_s, azimuth_rad in zip(trial.truth.time_s[seen], trial.truth.azimuth_rad[seen], strict=True):
        now = np.flatnonzero(np.abs(tracks.time_s - time_s) < 0.05)
        apart = np.abs(tracks.azimuth_rad[now] - azimuth_rad)
        if apart.min(initial=np.inf) < np.radians(15.0):
            nearest.append(tracks.track[now[apart.argmin()]])
    if not nearest:
        return False
    numbers, counts = np.unique(nearest, return_counts=True)
    return bool(tracks.time_s[tracks.track == numbers[counts.argmax()]].min() < trial.t0_s - 0.05)
