"""Measurements, checkpoints and times that the filter refuses, one row for each."""

import json
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from worldstate import Context, Measurement, NotUsable, Sighting, SignatureEvidence, WorldFilter
from worldstate.abduction.co_evidence import Absent
from worldstate.abduction.evidence import SideEvidence
from worldstate.abduction.sequence.sequence_model import GROUPS
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.core.budget_watch import RATES, BudgetWatch, Evidence
from worldstate.ground.errors import InvalidArgumentError, WorldstateError
from worldstate.measurement import Bearing, CameraLook, Look, Position, PositionScan, SearchedSector, Sector

SIDES, OFF, SHARE = ("left", "right"), NotUsable("-"), np.full(len(GROUPS), 1.0 / len(GROUPS))
CAR, LOOK = Sighting(0.1, 0.02, "car", 0.9), Look("camera", 10**8, Absent(0.04), (-0.5, 0.5))
READING = SequenceReading(np.stack([SHARE, SHARE]), SHARE)
HOP = Measurement(10**8, SignatureEvidence(SIDES, (4.0, 0.0), 2.0, 0.0), Absent(0.04), OFF, OFF, (CAR,))


def position(at=(1.0, 0.0), covariance=((1.0, 0.0), (0.0, 1.0)), velocity=None, **more):
    return lambda: Position(at, covariance, velocity, **more)


def searched(half_width_rad=1.0, range_m=10.0):
    return lambda: SearchedSector(Sector(0.0, half_width_rad), range_m, 0.5)


def updated(measurement):
    return lambda: WorldFilter().update(measurement)


def checkpoint(change):
    """Return a call that reads a checkpoint after a change."""
    written = json.loads(json.dumps(WorldFilter().update(replace(HOP, sequence=READING)).to_dict()))
    change(written)
    return lambda: WorldFilter.from_dict(written)


def watch(**changes):
    return lambda: replace(BudgetWatch(), **changes).check(2)


LIKELIHOODS = {
    "a likelihood of None": (None, 0.0),
    "a likelihood of text": ("a", 0.0),
    "a likelihood that is no number": (math.nan, 0.0),
    "a likelihood for one of two sides": (0.0,),
    "likelihoods without sides": 1.0,
    "a likelihood of 1e30 nats": (1e30, 0.0),
    "a likelihood of -1001 nats": (0, -1001),
}
REFUSALS: dict[str, tuple[Callable[[], object], str]] = {
    "bearing with a spread of zero": (lambda: Bearing(0.1, 0.0), "std_rad: expected a number in .*, got 0.0"),
    "sighting of None": (lambda: replace(HOP, sightings=(CAR, None)), r"sightings\[1\]: expected Sighting"),
    "33 further cameras": (
        lambda: replace(HOP, look=LOOK, further=(CameraLook(LOOK),) * 33),
        "further: expected at most 32, got 33",
    ),
    "box beyond half a turn": (lambda: CameraLook(LOOK, (replace(CAR, azimuth_rad=4.0),)), "azimuth_rad"),
    **{f"{name} in evidence": (lambda bad=bad: SignatureEvidence(SIDES, bad, 0.0, 0.0), "hidden")
       for name, bad in LIKELIHOODS.items()},
    **{f"{name} in sides": (lambda bad=bad: SideEvidence(SIDES, bad, 0.0, 0.0, 0.0), "log_ratios")
       for name, bad in LIKELIHOODS.items()},
    "position 1,000 km away": (position((1e6, 0.0)), r"position_m\[0\]: expected a number in"),
    "velocity without its covariance": (position(velocity=(1.0, 0.0)), r"covariance: .* \(4, 4\)"),
    "indefinite covariance": (position(covariance=((1.0, 2.0), (2.0, 1.0))), "covariance: .* symmetric"),
    "asymmetric covariance": (position(covariance=((1.0, 0.5), (0.0, 1.0))), "covariance: .* symmetric"),
    "covariance of 10 km": (position(covariance=((1e8, 0.0), (0.0, 1.0))), "covariance: .* eigenvalues"),
    "certain position": (position(existence_probability=1.0), "existence_probability"),
    "class with a share of two": (position(classes=(("car", 2.0),)), "classes"),
    "search of more than a turn": (searched(9.0), "half_width_rad"),
    "search of a negative range": (searched(range_m=-1.0), "range_m"),
    "scan without a source": (lambda: PositionScan("", 0), "source: expected a name"),
    "129 positions": (lambda: PositionScan("radar", 0, (position()(),) * 129), "positions: .* 128"),
    "ego speed that is no number": (lambda: Context(ego_speed_mps=math.nan), "ego_speed_mps"),
    "reading of one side": (lambda: replace(READING, groups=READING.groups[:1]), "groups"),
    "number as a reading": (lambda: replace(HOP, sequence=0.5), "sequence: expected .*NotUsable"),
    **{f"update with {name}": (updated(one), "measurement: expected")
       for name, one in {"None": None, "5": 5, "a filter": WorldFilter(), "a box": CAR}.items()},
    **{f"prediction to {stamp!r}": (lambda stamp=stamp: WorldFilter().predict_to(stamp), "stamp_ns")
       for stamp in (math.nan, 1.5e9, "1500000000", None, True, 2**63, -(2**63), 10**30)},
    **{f"start at {stamp!r}": (lambda stamp=stamp: WorldFilter(start_ns=stamp), "start_ns")
       for stamp in (math.inf, "1500000000", None, True, 2**63)},
    "prediction into the past": (lambda: WorldFilter(start_ns=10**9).predict_to(0), "not before"),
    "prediction by a negative time": (lambda: WorldFilter().predict(-0.1), "dt_s"),
    "checkpoint of another version": (
        checkpoint(lambda one: one.update(schema={"name": "worldstate.Filter", "version": "2.4.0"})),
        "schema",
    ),
    "checkpoint with a negative variance": (
        checkpoint(lambda one: one["memory"]["tracks"][0]["covariance"].__setitem__(0, -1.0)),
        r"tracks\[0\]\.covariance",
    ),
    "checkpoint with a share of two": (
        checkpoint(lambda one: one["memory"]["belief"].update(share=[2.0] * len(GROUPS))),
        r"belief\.share",
    ),
    "watch of one side": (watch(over_ns=(None,)), "watch"),
    "watch with one bet": (watch(bet=(0, (0.1,))), "watch"),
    "watch with evidence of one rate": (watch(within=Evidence((1.0,))), "watch"),
    "watch with evidence of zero": (watch(onsets=Evidence((0.0,) * len(RATES))), "watch"),
    "watch with evidence of 1e9": (watch(onsets=Evidence((1e9,) * len(RATES))), "watch"),
}  # fmt: skip


@pytest.mark.parametrize(("call", "words"), REFUSALS.values(), ids=REFUSALS)
def test_refuses(call, words):
    with pytest.raises(WorldstateError, match=words) as refused:
        call()
    assert isinstance(refused.value, InvalidArgumentError) or words == "schema"
