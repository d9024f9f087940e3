"""Scores that an evaluation saves for later comparison, and the comparison of two evaluations."""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from worldstate.adapters.files.file_io import load_npz, save_npz
from worldstate.ground.checks import check_shape
from worldstate.ground.errors import InputFileError, InvalidArgumentError, SchemaVersionError
from worldstate.ground.serialisation import decode
from worldstate.ground.typing import AnyArray, IndexArray
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.metrics.intervals import DRAWS, stratified_draws

from .reduction import BEARING_COLUMNS
from .scores import COUNTS, Score, Scored, paired_on

NAME = "scores.npz"
# Version of the arrays and of the meaning of the figures. Added counts need a new version.
VERSION = 2
MAX_BYTES = 4 << 30
# Maximum number of recordings that an error message lists by name.
_TOLD = 3

Key = tuple[str, str]  # Protocol and method


@dataclass(frozen=True, slots=True)
class Comparison:
    """One method under one protocol in two evaluations, on the recordings common to both."""

    protocol: str
    method: str
    shared: int  # Recordings with equal name, junction and content
    # By figure: our value minus the other one, and the central 95 % over draws of the shared recordings.
    differences: Mapping[str, tuple[float, float, float]]


# Fields of a score that are one array each and are written unchanged.
_PLAIN = tuple(one.name for one in fields(Score) if one.name not in ("recordings", "counts", "bearings"))


def save_scores(folder: Path, scores: Mapping[str, Mapping[str, Score]]) -> None:
    """Write every score by protocol and method; the scores of an earlier evaluation are replaced."""
    every = [(protocol, method, one) for protocol, some in scores.items() for method, one in some.items()]
    heads = [
        {"protocol": protocol, "method": method, "recordings": [asdict(row) for row in score.recordings]}
        for protocol, method, score in every
    ]
    arrays = {"": np.array(json.dumps({"version": VERSION, "counts": COUNTS, "scores": heads}))}
    for number, (_, _, score) in enumerate(every):
        arrays |= {f"{number} {name}": values for name, values in _arrays(score).items()}
    save_npz(folder / NAME, arrays)


def load_scores(folder: Path) -> dict[Key, Score]:
    """Read the scores that `save_scores` wrote, by protocol and method."""
    path = folder / NAME
    if not path.is_file():
        raise InputFileError(folder, f"expected a finished evaluation, with {NAME} in it")
    return load_npz(path, "scores of an evaluation", MAX_BYTES, _reader(path))


def compare(ours: Path, other: Path, rng: np.random.Generator, draws: int = DRAWS) -> tuple[Comparison, ...]:
    """Compare two finished evaluations, method by method and protocol by protocol.

    Raises
    ------
    InvalidArgumentError
        If the evaluations share no method under any protocol, or no recording.
    """
    a, b = load_scores(ours), load_scores(other)
    both = [key for key in a if key in b]
    if not both:
        told = "; ".join(
            f"{folder} has {_some(map(' / '.join, one))}" for folder, one in ((ours, a), (other, b))
        )
        raise InvalidArgumentError(f"expected a method under one protocol in both evaluations: {told}")
    compared = tuple(_compare(key, a[key], b[key], rng, draws) for key in both)
    if not any(one.shared for one in compared):
        raise InvalidArgumentError(_nothing_shared([(a[key], b[key]) for key in both]))
    return compared


def _compare(key: Key, a: Score, b: Score, rng: np.random.Generator, draws: int) -> Comparison:
    rows, others = _shared_rows(a, b)
    # Strata of the shared recordings only: a stratum that lost recordings is drawn at its remaining size.
    samples = stratified_draws([a.draw_strata[row] for row in rows], rng, draws)
    return Comparison(*key, len(rows), paired_on(a, b, rows, others, samples))


def _shared_rows(a: Score, b: Score) -> tuple[IndexArray, IndexArray]:
    """Return the rows of the shared recordings in both scores, in the order of the first."""
    # A recording that was cut or edited in the meantime keeps its name, so its content must match as well.
    place = {(one.site, one.name, one.fingerprint): row for row, one in enumerate(b.recordings)}
    keys = [(one.site, one.name, one.fingerprint) for one in a.recordings]
    pairs = [(row, place[key]) for row, key in enumerate(keys) if key in place]
    rows = np.array(pairs, np.intp).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def _nothing_shared(pairs: list[tuple[Score, Score]]) -> str:
    """Return why the evaluations share no recording: other names, or equal names with other content."""
    ours, other = ({(r.site, r.name) for pair in pairs for r in pair[i].recordings} for i in (0, 1))
    same = sorted(ours & other)
    if same:
        return f"expected shared recordings, but {_some(map('/'.join, same))} differ in their content"
    told = (_some(map("/".join, sorted(names))) for names in (ours, other))
    return "expected shared recordings, but one has {} and the other {}".format(*told)


def _some(names: Iterable[str]) -> str:
    every = list(names)
    return ", ".join(every[:_TOLD]) + (f" and {len(every) - _TOLD} more" if len(every) > _TOLD else "")


def _arrays(score: Score) -> dict[str, AnyArray]:
    bearings = [
        np.column_stack([np.full(len(table), seed), *(table.columns[name] for name in BEARING_COLUMNS)])
        for seed, table in enumerate(score.bearings)
    ]
    plain = {name: getattr(score, name) for name in _PLAIN}
    return {**plain, "counts": np.array(list(score.counts.values())), "bearings": np.concatenate(bearings)}


def _reader(path: Path) -> Callable[[dict[str, AnyArray]], dict[Key, Score]]:
    def read(arrays: dict[str, AnyArray]) -> dict[Key, Score]:
        head = json.loads(str(arrays.pop("")))
        if head["version"] != VERSION or head["counts"] != list(COUNTS):
            raise SchemaVersionError(path, f"expected scores of version {VERSION}, got {head['version']}")
        scores = {}
        for number, one in enumerate(head["scores"]):
            recordings = tuple(decode(Scored, row, "recordings") for row in one["recordings"])
            names = (*_PLAIN, "counts", "bearings")
            own = {name: arrays[f"{number} {name}"] for name in names}
            scores[one["protocol"], one["method"]] = _score(recordings, own)
        return scores

    return read


def _score(recordings: tuple[Scored, ...], arrays: dict[str, AnyArray]) -> Score:
    counts, samples = arrays.pop("counts"), arrays.pop("bearings")
    check_shape("counts", counts.shape, (len(COUNTS), None, len(recordings)))
    tables = [samples[samples[:, 0] == seed, 1:] for seed in range(counts.shape[1])]
    bearings = tuple(HopTable(dict(zip(BEARING_COLUMNS, table.T, strict=True))) for table in tables)
    return Score(recordings, dict(zip(COUNTS, counts, strict=True)), bearings=bearings, **arrays)
