"""`worldstate-lab foreign`: separation of sounds outside the models' domain from streets.

Train a domain guard on streams and on simulated sounds at their sites, and evaluate it on sounds outside its
training: every kind of sound with a guard trained without that kind, every family of kinds with one trained
without that family, and every street with one trained without that site. The threshold is set on the other
sites: at most 0.025 of the hops of each of hidden, in view and empty are flagged there, and it is not below
the threshold chosen on CC0 recordings. Close passes and sounds away from junctions are part of training and
evaluation, too.

Speech, music, bells, tools, tones, birds, steps and rain are foreign; siren, horn, reversing beeper and
bicycle bell are warning signals, which come from vehicles. A hop is used if the sound is at least as loud as
the ambience, from 250 to 2600 Hz over one second.

Examples
--------
  worldstate-lab foreign SA1-busy-1.npz SB1-busy-1.npz SB2-busy-1.npz
"""

import argparse
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path

import numpy as np

from worldstate.abduction.road_users import DomainGuard, Foreign, WarningSignal
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar
from worldstate.commissioning.guard_training import (
    CC0_THRESHOLD,
    FOREIGN,
    OF_STREETS,
    SIGNALS,
    STREET,
    SoundRows,
    close_rows,
    fit_guard,
    guard_rows,
    of_guard,
    threshold_of,
)
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray
from worldstate_lab.report.table import Table

# Families of similar kinds, each left out as a whole.
FAMILIES: Mapping[str, tuple[str, ...]] = {
    "speech": ("voice", "children"),
    "music": ("music", "tune", "drums"),
    "ringing": ("bell", "tone"),
    "tools": ("saw", "drill", "jackhammer"),
    "impacts": ("steps", "rain", "shots"),
    "animals": ("birds", "dog"),
}
# Kinds left out of training, and the kinds evaluated: none, every kind, every family of several.
EXAMS: tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...] = (
    ("nothing", (), (*STREET, *FOREIGN, *SIGNALS)),
    *((kind, (kind,), (kind,)) for kind in FOREIGN),
    *((family, kinds, kinds) for family, kinds in FAMILIES.items() if len(kinds) > 1),
)
_FOREIGN, _SIGNAL = 1.0, 2.0


@dataclass(frozen=True, slots=True)
class GuardShares:
    """Verdicts of a guard on the hops of one kind of sound."""

    without: str  # Left out of its training: nothing, a kind or a family; always the site
    kind: str
    hops: int
    foreign: float  # Share classified as foreign
    signal: float  # Share classified as a warning signal


def guard_exam(rows: SoundRows, advance: Callable[[], object] = lambda: None) -> list[GuardShares]:
    """Evaluate every kind with a guard of all kinds, without the kind, and without its family."""
    found = []
    for name, without, kinds in EXAMS:
        verdicts = _verdicts(rows, without, kinds)
        found += [_shares(rows, verdicts, name, kind) for kind in kinds if (rows.kinds == kind).any()]
        advance()
    return found


def _shares(rows: SoundRows, verdicts: FloatArray, without: str, kind: str) -> GuardShares:
    here = rows.kinds == kind
    return GuardShares(
        without=without,
        kind=kind,
        hops=int(here.sum()),
        foreign=float((verdicts[here] == _FOREIGN).mean()),
        signal=float((verdicts[here] == _SIGNAL).mean()),
    )


def _verdicts(rows: SoundRows, without: Collection[str], kinds: Collection[str]) -> FloatArray:
    """Return 0 for the street, else a code, by guards trained without the site, shape (n,)."""
    sites = np.unique(rows.sites).tolist()
    guards = {
        one: fit_guard(rows.select((rows.sites != one) & ~np.isin(rows.kinds, list(without))))
        for one in sites
    }
    out = np.zeros(len(rows.kinds))
    excesses = {
        (one, label): guard.log_odds(rows.measures[(rows.sites == one) & (rows.kinds == label)])
        for one, guard in guards.items()
        for label in OF_STREETS
    }
    for one, guard in guards.items():
        others = [
            np.concatenate([excesses[other, label] for other in sites if other != one])
            for label in OF_STREETS
        ]
        chosen = replace(guard, threshold=max(threshold_of(others), CC0_THRESHOLD))
        here = np.flatnonzero((rows.sites == one) & np.isin(rows.kinds, list(kinds)))
        out[here] = [_code(chosen, rows.measures[i]) for i in here]
    return out


def _code(guard: DomainGuard, measures: FloatArray) -> float:
    verdict = guard.judge(measures)
    if isinstance(verdict, WarningSignal):
        return _SIGNAL
    return _FOREIGN if isinstance(verdict, Foreign) else 0.0


CLIPS_EACH, GUARD_RATE_HZ = 8, 6000.0  # The same number in every fold
SITES = 3  # Minimum: one evaluated site and two that set its threshold


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    heard = f"processed simulated streams of {SITES} sites or more"
    add("streams", type=Path, nargs="+", metavar="NPZ", help=heard)
    add("--sounds", type=int, default=2, metavar="N", help="of each kind per site (default: %(default)s)")
    add("--seed", type=int, default=0, help="seed of the sounds (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    in_range("--sounds", arguments.sounds, 1, 100)
    streams = [HeardStream.load(path) for path in arguments.streams]
    sites = sorted({str(stream.hops.about["site"]) for stream in streams})
    if len(sites) < SITES:
        raise InvalidArgumentError(f"NPZ: expected streams of {SITES} sites or more, got {', '.join(sites)}")
    # One microphone is used; the choice of its array changes nothing but the level.
    rng = np.random.default_rng(arguments.seed)
    rows = guard_rows(ovad_array(), streams, rng, arguments.sounds)
    rows = SoundRows.joined([rows, of_guard(close_rows(GUARD_RATE_HZ, rng, CLIPS_EACH))])
    with progress_bar("training guards", len(EXAMS)) as bar:
        found = guard_exam(rows, bar.advance)
    heads = ("guard without", "kind", "hops", "foreign", "signal")
    lines = Table("guards", "", heads, [astuple(one) for one in found]).lines()[1:]
    report = {"sites": sites, "seed": arguments.seed, "rows": [asdict(one) for one in found]}
    return CommandResult(report, table={}, lines=lines)
