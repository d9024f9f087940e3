"""`worldstate-lab four`: the product on real road users behind corners, with a board of four microphones.

FOLDER has truth.csv (file, site, side, kind, seconds) and the recordings; MODEL was made for the board. The
time of coming into view is unknown, and outdoor recordings continue after it. Three questions are evaluated:

- the side of each vehicle outdoors in the second half of its recording: the side with the larger mean
  published risk;
- the area under the ROC curve of 1 - P(none) of the hops in the last two seconds against those in the first
  two of the same recording, averaged over recordings of 5 s and more;
- advisories by kind: one for a person is a failure of the guard.

Some channels of these recordings are early by whole buffers of 1024 samples. The offsets are estimated from
the sound alone, and the channels are aligned; figures without alignment are given as `as_recorded`.

Carts, and recordings without a side, are listed and not scored.

Examples
--------
  worldstate-lab four four-microphones --model board.json
  worldstate-lab four four-microphones --model board.json --json --jobs 2
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.files.file_io import read_rows
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.adapters.listener import Listener, Step
from worldstate.adapters.source import open_source
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.ground.errors import InputFileError
from worldstate.ground.parallel import in_processes
from worldstate.ground.typing import Float32Array
from worldstate.ground.values import seconds
from worldstate.operations.metrics.approach_table import Figures, auroc, mean_of, share_interval
from worldstate_lab.metrics.intervals import stratified_draws
from worldstate_lab.report.table import MISSING, Table, Value, cell_text

BUFFER = 1024
# Band of the comparison for lost buffers: wind below, little sound of vehicles above.
_BAND_HZ = (200.0, 6000.0)
_ENDS_S, _LEAST_S = 2.0, 5.0
_PERSONS = ("human", "man", "woman")
_OUTDOORS, _UNSCORED = "OA", ("cart", "")
_CENTRAL = (0.025, 0.975)


@dataclass(frozen=True, slots=True)
class BoardRecording:
    """One recording and its truth."""

    path: Path
    site: str
    side: str
    kind: str

    @property
    def scored(self) -> bool:
        """Whether it has a side and a kind that occurs in streets."""
        return self.side in SIDES and self.kind not in _UNSCORED

    @property
    def drives_outdoors(self) -> bool:
        """Whether it is a car in the street."""
        return self.scored and self.site == _OUTDOORS and self.kind == "car"


@dataclass(frozen=True, slots=True)
class BoardOutcome:
    """Output of the product for a recording."""

    recording: BoardRecording
    hops: int
    buffers: tuple[int, ...]  # Lost buffers of each channel
    side: str | None
    rise: float | None  # AUROC of the last two seconds against the first two
    advised: bool


def read_board(folder: Path) -> list[BoardRecording]:
    """Read truth.csv."""
    rows = read_rows(folder / "truth.csv", ("file", "site", "side", "kind"))
    found = [BoardRecording(folder / r["file"], r["site"], r["side"], r["kind"]) for _, r in rows]
    if not found:
        raise InputFileError(folder / "truth.csv", "expected recordings, got none")
    return found


def lost_buffers(sound: Float32Array, sample_rate_hz: float) -> tuple[int, ...]:
    r"""Return the number of buffers that each channel (n, M) lost before the sound began, at least 0.

    It is the peak of the cross-correlation with the first channel, phases alone,

    .. math:: \hat\tau_m = \arg\max_\tau \Big| \sum_f \frac{X_m X_0^*}{|X_m X_0|} e^{2 \pi j f \tau} \Big|

    in whole buffers, because a board of centimetres delays sound by a few samples only.
    """
    n = 2 * len(sound)
    spectra = np.fft.rfft(sound, n, axis=0)
    cross = spectra * spectra[:, :1].conj()
    hertz = np.fft.rfftfreq(n, 1.0 / sample_rate_hz)[:, None]
    heard = (hertz > _BAND_HZ[0]) & (hertz < _BAND_HZ[1])
    phases = np.where(heard, cross / np.maximum(np.abs(cross), np.finfo(np.float32).tiny), 0.0)
    late = np.abs(np.fft.irfft(phases, n, axis=0)).argmax(axis=0)
    late = np.round(((late + n // 2) % n - n // 2) / BUFFER).astype(int)
    return tuple((late.max() - late).tolist())


def aligned(sound: Float32Array, buffers: Sequence[int]) -> Float32Array:
    """Align every channel (n, M) with the channel that lost the fewest buffers."""
    starts = BUFFER * (max(buffers) - np.array(buffers))
    length = len(sound) - int(starts.max())
    return np.stack([sound[at : at + length, m] for m, at in enumerate(starts.tolist())], axis=1)


def heard(recording: BoardRecording, model: Model, array: Path | None, *, align: bool) -> BoardOutcome:
    """Run one recording through the whole product, without a camera."""
    source = open_source(recording.path, array=array, model=model)
    with open_sound(recording.path, source.array.n_microphones) as audio:
        rate_hz = audio.sample_rate_hz
        sound = np.concatenate(list(audio.blocks(rate_hz)))
    buffers = lost_buffers(sound, rate_hz)
    sound = aligned(sound, buffers) if align else sound
    return outcome(recording, buffers, list(Listener(source, rate_hz).steps(sound)), len(sound) / rate_hz)


def outcome(
    recording: BoardRecording, buffers: tuple[int, ...], steps: Sequence[Step], duration_s: float
) -> BoardOutcome:
    """Score the hops of one recording."""
    time_s = np.array([seconds(one.state.stamp_ns) for one in steps])
    told = [one.state.cues[0].hypotheses for one in steps]
    present = np.array([np.nan if one is None else 1.0 - one.none for one in told])
    advised = any(cue.advisory is not None for one in steps for cue in one.state.cues)
    side = _of_risk([one for one, at_s in zip(steps, time_s, strict=True) if at_s > 0.5 * duration_s])
    ends = time_s > duration_s - _ENDS_S
    kept = ends | (time_s <= _ENDS_S)
    rise = auroc(present[kept], ends[kept]) if duration_s >= _LEAST_S else None
    return BoardOutcome(recording, len(steps), buffers, side, rise, advised)


def _of_risk(steps: Sequence[Step]) -> str | None:
    """Return the side with the larger mean risk; None without risks."""
    risks = [
        {cue.direction: np.nan if cue.risk is None else cue.risk for cue in one.state.cues} for one in steps
    ]
    leftwards = float(np.nansum([one[SIDES[0]] - one[SIDES[1]] for one in risks]))
    return None if leftwards == 0.0 else SIDES[0] if leftwards > 0.0 else SIDES[1]


def run_figures(outcomes: Sequence[BoardOutcome], rng: np.random.Generator) -> dict[str, Any]:
    """Return the figures of all recordings."""
    scored = [one for one in outcomes if one.recording.scored]
    cars = [one for one in scored if one.recording.drives_outdoors]
    persons = [one for one in scored if one.recording.kind in _PERSONS]
    return {
        "by_kind": {name: counts(some) for name, some in _by("kind", scored).items()},
        "side": side_figures(cars),
        "hazard": hazard_figures(cars, rng),
        "persons": {"recordings": len(persons), "advisories": sum(one.advised for one in persons)},
    }


def _by(what: str, outcomes: Sequence[BoardOutcome]) -> dict[str, list[BoardOutcome]]:
    """Group outcomes by an attribute of their recordings."""
    found: dict[str, list[BoardOutcome]] = {}
    for one in sorted(outcomes, key=attrgetter(f"recording.{what}")):
        found.setdefault(getattr(one.recording, what), []).append(one)
    return found


def counts(outcomes: Sequence[BoardOutcome]) -> Figures:
    """Return the counts of a group: with an advisory, with the correct side, with more hazard at the end."""
    rises = [one.rise for one in outcomes if one.rise is not None]
    return {
        "count": len(outcomes),
        "hops": sum(one.hops for one in outcomes),
        "advisories": sum(one.advised for one in outcomes),
        "side_right": _right(outcomes),
        "hazard_higher": sum(one > 0.5 for one in rises),
        "hazard_of": len(rises),
    }


def _right(outcomes: Sequence[BoardOutcome]) -> int:
    return sum(one.side == one.recording.side for one in outcomes)


def side_figures(outcomes: Sequence[BoardOutcome]) -> dict[str, Any]:
    """Return the share of correct sides, with its exact interval, and the mean recall of both sides."""
    right, of = _right(outcomes), len(outcomes)
    recalls = [_right(some) / len(some) for some in _by("side", outcomes).values()]
    return {
        "right": right,
        "of": of,
        "share": right / of if of else None,
        "interval": share_interval(right, of) if of else None,
        # If one side was not recorded there is no mean over both.
        "balanced": mean_of(recalls) if len(recalls) == len(SIDES) else None,
    }


def hazard_figures(outcomes: Sequence[BoardOutcome], rng: np.random.Generator) -> dict[str, Any]:
    """Return the mean over recordings of the AUROC of the last seconds against the first."""
    known = [one for one in outcomes if one.rise is not None]
    rises = np.array([one.rise for one in known], float)
    interval = None
    if known:
        drawn = rises[stratified_draws([one.recording.side for one in known], rng)].mean(axis=1)
        interval = np.quantile(drawn, _CENTRAL).tolist()
    return {"auroc": mean_of(rises), "pairs": len(known), "interval": interval}


def _lines(title: str, figures: Mapping[str, Any]) -> list[str]:
    names = ("count", "advisories", "side_right", "hazard_higher", "hazard_of")
    rows = [(kind, *(one[name] for name in names)) for kind, one in figures["by_kind"].items()]
    side, hazard, persons = figures["side"], figures["hazard"], figures["persons"]
    return [
        "",
        *Table("kinds", title, ("by kind", *names), rows).lines(),
        f"side: {side['right']} of {side['of']}, {_shown(side, 'share')}, "
        f"mean of both sides {cell_text(side['balanced'])}",
        f"last 2 s against the first 2 s: AUROC {_shown(hazard, 'auroc')}, {hazard['pairs']} recordings",
        f"persons with an advisory: {persons['advisories']} of {persons['recordings']}",
    ]


def _shown(figures: Mapping[str, Any], name: str) -> str:
    return Value(figures[name], *figures["interval"]).text if figures["interval"] else MISSING


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="truth.csv and its recordings")
    add("--model", type=Path, required=True, metavar="FILE", help="model for the board, from model make")
    add("--array", type=Path, metavar="FILE", help="microphone positions (default: the model's)")
    add("--seed", type=int, default=0, help="seed of the intervals (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    recordings, model = read_board(arguments.folder), read_model(arguments.model)
    found: dict[str, Any] = {}
    for align, title in ((True, "channels aligned"), (False, "as recorded")):
        work = partial(heard, model=model, array=arguments.array, align=align)
        outcomes = list(track(in_processes(work, recordings, arguments.jobs), title, len(recordings)))
        found[title] = run_figures(outcomes, np.random.default_rng(arguments.seed))
    lost = [one.recording.path.name for one in outcomes if any(one.buffers)]
    listed = [one.path.name for one in recordings if not one.scored]
    report = {
        "recordings": len(recordings),
        "lost_buffers": len(lost),
        "listed": listed,
        **found["channels aligned"],
        "as_recorded": found["as recorded"],
    }
    lines = [f"{len(lost)} of {len(recordings)} recordings have channels with lost buffers"]
    lines += [line for title, one in found.items() for line in _lines(title, one)]
    lines += ["", f"listed but not scored: {', '.join(listed)}"]
    return CommandResult(report, table={}, lines=lines)
