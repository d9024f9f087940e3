"""Comparison of ways in which single windows enter the filter, alone or through a sequence model.

Each recording is processed once; its measurements then pass through every filter, with and without the
camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from worldstate.adapters.acoustic import Grounding, asked_again, observe
from worldstate.adapters.listener import Step
from worldstate.adapters.source import Source
from worldstate.belief.settings import FilterSettings
from worldstate.belief.street_model import StreetModel
from worldstate.cli.common.progress import track
from worldstate.core.filter import WorldFilter
from worldstate.ground.parallel import in_processes
from worldstate.measurement.measurement import Measurement
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.passes.followed_stream import chances, cues_of
from worldstate_lab.report.table import Table, Value
from worldstate_lab.trials.trial import Trial

from .hearing import Chain
from .recordings import CornerRecording
from .scores import Row, alarm_row, calibration, curve, leads

LEADS, CAMERAS = ("0.5", "1", "2"), {"with the camera": True, "sound alone": False}


@dataclass(frozen=True, slots=True)
class WindowFilter:
    """One way in which windows enter the filter."""

    name: str
    windows: Literal["posterior", "likelihood"] = "posterior"
    sequence: bool = False  # Whether a sequence model is used
    grounded: bool = False  # Whether bearing and approach rate weight them, eq. (5)

    def measured(self, step: Step, camera: bool) -> Measurement:
        """Return the measurement of a hop in the form that this filter receives."""
        one = step.measurement if camera else asked_again(step.measurement, None)
        if self.grounded and one.heard.usable:
            seen = observe(step.frame, one.bearing, one.approach)
            one = replace(one, signature=Grounding().answer(one.signature, seen).evidence)
        return one if self.sequence else replace(one, sequence=None)

    def trial(self, source: Source, steps: Sequence[Step], recording: CornerRecording, camera: bool) -> Trial:
        """Return the states that the filter publishes for a recording."""
        settings = FilterSettings(street=source.street or StreetModel(), windows=self.windows)
        world, rows = WorldFilter(source.context, source.policy, settings), []
        for step in steps:
            measurement = self.measured(step, camera)
            world = world.predict_to(measurement.stamp_ns).update(measurement)
            said = [(one.risk, chances(one), one.advisory is not None) for one in cues_of(world.state)]
            rows.append((measurement.stamp_ns * 1e-9, *map(np.array, zip(*said, strict=True))))
        hops = HopTable.of_rows(("time_s", "risk", "within", "advised"), rows)
        about = {"site": recording.junction, "leads_from_s": recording.t0_s}
        t0_s = np.nan if recording.hazard_free else recording.t0_s
        return Trial(hops.replace(name=recording.name, label=recording.side, t0_s=t0_s, about=about))


FILTERS = (
    WindowFilter("sequence", sequence=True),
    WindowFilter("sequence, windows multiplied", "likelihood", sequence=True),
    WindowFilter("sequence, eq. (5)", sequence=True, grounded=True),
    WindowFilter("windows, what is new"),
    WindowFilter("windows, what is new, eq. (5)", grounded=True),
    WindowFilter("windows, multiplied", "likelihood"),
    WindowFilter("windows, multiplied, eq. (5)", "likelihood", grounded=True),
)


def window_rows(chain: Chain, recordings: Sequence[CornerRecording], seed: int, jobs: int) -> dict[str, Any]:
    """Return the row of every filter, with the camera and with sound alone."""
    work = in_processes(partial(_trials, chain), recordings, jobs)
    every = list(track(work, f"listening, {chain.path}", len(recordings)))
    return {
        camera: {
            one.name: _row([trials[camera, one.name] for trials in every], np.random.default_rng(seed))
            for one in FILTERS
        }
        for camera in CAMERAS
    }


def _trials(chain: Chain, recording: CornerRecording) -> dict[tuple[str, str], Trial]:
    source, steps = chain.source(recording), list(chain.steps(recording))
    return {
        (name, one.name): one.trial(source, steps, recording, camera)
        for name, camera in CAMERAS.items()
        for one in FILTERS
    }


def _row(trials: Sequence[Trial], rng: np.random.Generator) -> Row:
    risks = [one.hops.risk for one in trials]
    alarms = [np.asarray(one.hops.advised.any(axis=1), bool) for one in trials]
    right, scores = [risk[:, 1] - risk[:, 0] for risk in risks], [risk.max(axis=1) for risk in risks]
    before = leads(trials, scores, right, rng)
    return {
        "leads": {lead: before[lead] for lead in LEADS},
        "at_onset": curve(trials, scores, "onsets", rng)["1"],
        "alarms": alarm_row(trials, [alarms], rng),
        "within_1s": calibration(trials, rng, within_s=1.0),
    }


def window_lines(path: str, found: dict[str, Any]) -> list[str]:
    """Return the rows as one table per camera setting."""
    areas = (*(f"{one} s" for one in LEADS), *(f"side {one} s" for one in LEADS[1:]))
    heads = ("filter", *areas, "skill 1 s", "advisories", "onsets <= 1")
    lines = list[str]()
    for camera, rows in found.items():
        cells = [(name, *_cells(row)) for name, row in rows.items()]
        lines += [*Table("windows", f"{path}: risk and advisories, {camera}", heads, cells).lines(), ""]
    return lines


def _cells(row: Row) -> tuple[Value | str, ...]:
    areas, skill, swept = row["leads"], row["within_1s"]["brier_skill"], row["at_onset"]
    return (
        *(Value(areas[lead]["auroc"], *areas[lead]["auroc_interval"]) for lead in LEADS),
        *(Value(areas[lead]["side_auroc"], *areas[lead]["side_auroc_interval"]) for lead in LEADS[1:]),
        Value(np.nan if skill is None else skill),
        row["alarms"]["text"],
        f"{swept['count']:g}, {swept['lead_s_missed_0']:.2f} s",
    )
