"""From recordings to trials: every pass over the sound, each recording's results kept by its content."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from worldstate.adapters.datasets.ovad import named_array
from worldstate.adapters.files.model_file import read_model
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import encode
from worldstate.operations.recordings.hop_table import HOP_S, HopTable
from worldstate_lab.trials.pass_cache import origin_of

from .listening import (
    VERSION,
    chain_tables,
    filtered_decisions,
    front_end_tables,
    model_refusal,
    unfiltered_decisions,
)
from .pass_cache import Failed, PassCache, content_hash, fingerprint
from .trial import DECISION_COLUMNS, Decisions, Take, Trial

ALPHA = 0.02
# Streams are cut into pieces of this length, dealt to folds in their order: a threshold is then set on other
# minutes of the same stream, and an alarm that lasts over a cut counts once more.
PIECE_S = 60.0
# What a model says of a recording that it was made for: decisions of whole chains, and scores by hop.
CHAIN_NAMES = ("shipped", "adapted", "filtered", "ego_noise")
SCORES = ("shipped", "grounded", "rateless")


@dataclass(frozen=True, slots=True)
class Hearing:
    """How recordings are heard, and where what was heard is kept."""

    folder: Path
    model: Path | None = None  # Model file of the chains; the one that ships where not given

    def __call__(self, take: Take) -> Trial:
        """Listen to one recording, or read back what an earlier run heard of the same content."""
        mark = fingerprint(take.path, self.folder / "fingerprints")
        model = read_model(self.model)
        array = named_array(take.path)
        about = [VERSION, take.name, take.label, take.t0_s, take.site, mark]
        about.append("" if array is None else content_hash(array))
        cache = PassCache(self.folder)
        heard = cache.tables("front_end", about, partial(front_end_tables, take))
        hops = heard["hops"].replace(about={**heard["hops"].about, "fingerprint": mark})
        refused = model_refusal(take, model)
        if refused is not None:
            unasked = (*(CHAIN_NAMES if take.moving else CHAIN_NAMES[:-1]), *SCORES)
            told = {**hops.about, "refused": dict.fromkeys(unasked, refused)}
            return Trial(hops.replace(about=told), heard["boxes"], heard["truth"])
        # What the chains say depends on the model, too, which the shipped one may change with a release.
        signed = [*about, origin_of(encode(model))]
        # A standing vehicle's own noise is not what the cancellation was made for.
        wanted = ("plain", "adapted", "ego_noise") if take.moving else ("plain", "adapted")
        said = {
            chain: cache.tables(chain, signed, partial(chain_tables, take, chain, self.model))
            for chain in wanted
        }
        policy = model.policies.for_alpha(ALPHA)
        chains = {
            "shipped": unfiltered_decisions(said["plain"], policy),
            "adapted": unfiltered_decisions(said["adapted"], policy),
            "filtered": filtered_decisions(said["adapted"]),
        }
        if take.moving:
            chains["ego_noise"] = filtered_decisions(said["ego_noise"])
        stream = said["plain"]["stream"]
        prior = list(model.signature.reference_prior)
        hops = hops.replace(
            shipped=stream.log_likelihoods,
            grounded=stream.grounded,
            rateless=stream.rateless,
            about={**hops.about, "prior": dict.fromkeys(SCORES, prior)},
        )
        return Trial(hops, heard["boxes"], heard["truth"], chains)


def hear(heard: Iterable[Trial | Failed]) -> tuple[list[Trial], list[Failed]]:
    """Return the trials in the order of the recordings, cut to pieces, and what cannot be read."""
    trials: list[Trial] = []
    failed: list[Failed] = []
    for found in heard:
        if isinstance(found, Failed):
            failed.append(found)
        else:
            trials += _pieces(found)
    return trials, failed


def within_hours(trials: Sequence[Trial], hours: float | None) -> list[Trial]:
    """Keep all approaches, and hazard-free recordings in their order until they make up so many hours."""
    if hours is None:
        return list(trials)
    kept, left_s = [], hours * 3600.0
    for trial in trials:
        if trial.hazard_free and left_s <= 1e-9:
            continue
        kept.append(trial)
        left_s -= scored_s(trial) if trial.hazard_free else 0.0
    if left_s > 1e-9:
        have = hours - left_s / 3600.0
        raise InvalidArgumentError(
            f"--hazard-free-hours: expected at most the {have:.4g} h at hand, got {hours:g}; "
            "give more with --hazard-free"
        )
    return kept


def scored_s(trial: Trial) -> float:
    """Return the time that is scored: one hop a decision."""
    return len(trial.hops) * HOP_S


def _pieces(trial: Trial) -> Iterator[Trial]:
    """Cut a long hazard-free recording into pieces."""
    time_s = trial.hops.time_s
    count = int(scored_s(trial) / PIECE_S)
    if not trial.hazard_free or count < 2:
        yield trial
        return
    edges_s = time_s[0] + PIECE_S * np.arange(count)
    for i, first_s in enumerate(edges_s.tolist()):
        last_s = edges_s[i + 1] if i + 1 < count else np.inf

        def inside(moments: np.ndarray, first_s: float = first_s, last_s: float = last_s) -> np.ndarray:
            return (moments >= first_s - 1e-6) & (moments < last_s - 1e-6)

        yield Trial(
            _rows(trial.hops, inside).replace(
                name=f"{trial.name}#{i:03d}", about={**trial.hops.about, "stream": trial.name}
            ),
            _rows(trial.boxes, inside),
            _rows(trial.truth, inside),
            {name: _cut(said, inside) for name, said in trial.chains.items()},
        )


Inside = Callable[[np.ndarray], np.ndarray]


def _rows(table: HopTable, inside: Inside) -> HopTable:
    kept = inside(table.time_s)
    return replace(table, columns={name: column[kept] for name, column in table.columns.items()})


def _cut(said: Decisions, inside: Inside) -> Decisions:
    kept = inside(said.time_s)
    columns: Mapping[str, np.ndarray] = {name: getattr(said, name)[kept] for name in DECISION_COLUMNS}
    return Decisions(**columns, tracks=_rows(said.tracks, inside))


def data_fingerprint(trials: Sequence[Trial]) -> str:
    """Name the content of all recordings of an evaluation in 32 characters."""
    return origin_of(sorted((trial.name, trial.hops.about["fingerprint"]) for trial in trials))
