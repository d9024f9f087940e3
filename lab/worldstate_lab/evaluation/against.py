"""What an evaluation leaves on disk to be compared with, and the comparison of two of them."""

import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.abduction.cueing.calibration_error import BINS
from worldstate.adapters.files.npz_file import load_npz, save_npz
from worldstate.ground.checks import check_shape
from worldstate.ground.errors import InputFileError, InvalidArgumentError, SchemaVersionError
from worldstate.ground.serialisation import decode
from worldstate.ground.typing import AnyArray, IndexArray
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.metrics.intervals import DRAWS, stratified_draws

from .reduction import BEARING_COLUMNS, HORIZONS_S
from .scores import COUNTS, Score, Scored, paired_on

FOLDER = "scores"
# Of the arrays; counts that a later version adds are another version.
VERSION = 1
MAX_BYTES = 512 << 20
# Of the names of recordings that an error spells out.
_TOLD = 3


@dataclass(frozen=True, slots=True, eq=False)
class SavedScore:
    """One method under one protocol, as it was written."""

    protocol: str
    method: str
    settings: Mapping[str, Any]  # What two evaluations must have in common to be compared
    score: Score


@dataclass(frozen=True, slots=True)
class Comparison:
    """One method under one protocol in two evaluations, on the recordings that both have."""

    protocol: str
    method: str
    shared: int  # Recordings of the same name, junction and content
    # Figure: ours less the other's, and the middle 95 % over draws of the shared recordings.
    differences: Mapping[str, tuple[float, float, float]]


# What a score keeps as one array, which is written as it stands.
_PLAIN = tuple(one.name for one in fields(Score) if one.name not in ("recordings", "counts", "bearings"))


def save_scores(
    folder: Path, scores: Mapping[str, Mapping[str, Score]], settings: Mapping[str, Any]
) -> list[Path]:
    """Write every score, by protocol and by method, in place of those of an earlier evaluation.

    `settings`, ready for JSON, is what a comparison refuses to differ in.
    """
    # In a folder of its own, in which whatever is no score of this evaluation may be removed.
    into = folder / FOLDER
    into.mkdir(parents=True, exist_ok=True)
    every = [
        SavedScore(protocol, method, settings, score)
        for protocol, methods in scores.items()
        for method, score in methods.items()
    ]
    names = [
        f"{i:03d}-{_file_part(one.protocol)}-{_file_part(one.method)}.npz" for i, one in enumerate(every)
    ]
    for name, one in zip(names, every, strict=True):
        save_npz(into / name, _arrays(one))
    # A method that is no longer asked must not be compared as if it were.
    for stale in set(into.glob("*.npz")) - {into / name for name in names}:
        stale.unlink()
    return [into / name for name in names]


def load_scores(folder: Path) -> dict[tuple[str, str], SavedScore]:
    """Read what `save_scores` wrote, by protocol and method."""
    paths = sorted((folder / FOLDER).glob("*.npz"))
    if not paths:
        raise InputFileError(folder, f"expected a finished evaluation, with the folder {FOLDER} in it")
    read = [load_npz(path, "scores of an evaluation", MAX_BYTES, _reader(path)) for path in paths]
    return {(one.protocol, one.method): one for one in read}


def compare(ours: Path, other: Path, rng: np.random.Generator, draws: int = DRAWS) -> tuple[Comparison, ...]:
    """Compare two finished evaluations, method by method and protocol by protocol.

    Raises
    ------
    InvalidArgumentError
        If they were set differently, or share no method under any protocol, or no recording.
    """
    a, b = load_scores(ours), load_scores(other)
    both = [key for key in a if key in b]
    if not both:
        told = "; ".join(
            f"{folder} has {_some(map(' / '.join, one))}" for folder, one in ((ours, a), (other, b))
        )
        raise InvalidArgumentError(f"expected a method under one protocol in both evaluations: {told}")
    for key in both:
        _check_settings(a[key], b[key])
    compared = tuple(_compare(a[key], b[key], rng, draws) for key in both)
    if not any(one.shared for one in compared):
        raise InvalidArgumentError(_nothing_shared([(a[key].score, b[key].score) for key in both]))
    return compared


def _compare(a: SavedScore, b: SavedScore, rng: np.random.Generator, draws: int) -> Comparison:
    rows, others = _shared_rows(a.score, b.score)
    # Strata of the shared recordings alone: a stratum that lost some is drawn at the size that is left.
    strata = [a.score.draw_strata[row] for row in rows]
    samples = stratified_draws(strata, rng, draws)
    return Comparison(
        protocol=a.protocol,
        method=a.method,
        shared=len(rows),
        differences=paired_on(a.score, b.score, rows, others, samples),
    )


def _shared_rows(a: Score, b: Score) -> tuple[IndexArray, IndexArray]:
    """Return the rows of the recordings that both have, in the order of the first."""
    # A recording that was cut or edited since keeps its name: its content has to be the same as well.
    place = {(one.site, one.name, one.fingerprint): row for row, one in enumerate(b.recordings)}
    keys = [(one.site, one.name, one.fingerprint) for one in a.recordings]
    pairs = [(row, place[key]) for row, key in enumerate(keys) if key in place]
    rows = np.array(pairs, np.intp).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def _check_settings(a: SavedScore, b: SavedScore) -> None:
    names = sorted(a.settings.keys() | b.settings.keys())
    differing = [name for name in names if a.settings.get(name) != b.settings.get(name)]
    if differing:
        told = "; ".join(
            f"{name} is {a.settings.get(name)}, not {b.settings.get(name)}" for name in differing
        )
        raise InvalidArgumentError(f"{a.protocol} / {a.method}: expected the same settings, but {told}")


def _nothing_shared(pairs: list[tuple[Score, Score]]) -> str:
    """Say why no recording is in both: other names, or the same names with other content."""
    ours, other = ({(r.site, r.name) for pair in pairs for r in pair[i].recordings} for i in (0, 1))
    same = sorted(ours & other)
    if same:
        return f"expected shared recordings, but {_some(map('/'.join, same))} differ in their content"
    told = (_some(map("/".join, sorted(names))) for names in (ours, other))
    return "expected shared recordings, but one has {} and the other {}".format(*told)


def _file_part(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "-", name)[:60]


def _some(names: Iterable[str]) -> str:
    every = list(names)
    return ", ".join(every[:_TOLD]) + (f" and {len(every) - _TOLD} more" if len(every) > _TOLD else "")


def _arrays(saved: SavedScore) -> dict[str, AnyArray]:
    """Return the arrays of a score by name, what is no array as JSON under the empty one."""
    score = saved.score
    head = {
        "version": VERSION,
        "protocol": saved.protocol,
        "method": saved.method,
        "settings": dict(saved.settings),
        "counts": list(score.counts),
        "recordings": [asdict(one) for one in score.recordings],
    }
    bearings = [
        np.column_stack([np.full(len(table), seed), *(table.columns[name] for name in BEARING_COLUMNS)])
        for seed, table in enumerate(score.bearings)
    ]
    plain = {name: getattr(score, name) for name in _PLAIN}
    counts, samples = np.array(list(score.counts.values())), np.concatenate(bearings)
    return {"": np.array(json.dumps(head)), **plain, "counts": counts, "bearings": samples}


def _reader(path: Path) -> Callable[[dict[str, AnyArray]], SavedScore]:
    def read(arrays: dict[str, AnyArray]) -> SavedScore:
        head = json.loads(str(arrays.pop("")))
        if head["version"] != VERSION or head["counts"] != list(COUNTS):
            raise SchemaVersionError(path, f"expected scores of version {VERSION}, got {head['version']}")
        recordings = tuple(decode(Scored, one, "recordings") for one in head["recordings"])
        return SavedScore(head["protocol"], head["method"], head["settings"], _score(recordings, arrays))

    return read


def _score(recordings: tuple[Scored, ...], arrays: dict[str, AnyArray]) -> Score:
    counts, samples = arrays.pop("counts"), arrays.pop("bearings")
    seeds = counts.shape[1]
    check_shape("counts", counts.shape, (len(COUNTS), None, len(recordings)))
    check_shape("bins", arrays["bins"].shape, (seeds, 2, len(recordings), BINS, 3))
    calm = sum(one.label == "none" for one in recordings)
    pairs = (len(recordings) - calm, calm)
    check_shape("wins", arrays["wins"].shape, (seeds, len(HORIZONS_S), *pairs))
    tables = [samples[samples[:, 0] == seed, 1:] for seed in range(seeds)]
    bearings = tuple(HopTable(dict(zip(BEARING_COLUMNS, table.T, strict=True))) for table in tables)
    return Score(recordings, dict(zip(COUNTS, counts, strict=True)), bearings=bearings, **arrays)
