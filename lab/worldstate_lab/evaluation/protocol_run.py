"""Every method on every protocol: fitted to calibration recordings, asked about the others."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.operations.metrics.approach_table import SECONDS_PER_HOUR, caution
from worldstate.operations.recordings.hop_stream import HOP_S
from worldstate_lab.trials.classification import Classifiers
from worldstate_lab.trials.trial import Decisions, Method, Trial

from .protocols import Protocol


@dataclass(frozen=True, slots=True, eq=False)
class ProtocolRun:
    """What every method said of every tested recording, once a seed."""

    protocol: Protocol
    trials: tuple[Trial, ...]
    # By method: a pass a seed, each with one answer a trial, in the order of the trials.
    decisions: Mapping[str, tuple[tuple[Decisions, ...], ...]]
    seeds: tuple[int, ...]
    trained_on: str  # What the published classifier was trained on

    @property
    def stands_on(self) -> dict[str, float]:
        """How many recordings of either kind were scored, and the hours without a vehicle."""
        calm = [len(trial.hops) for trial in self.trials if trial.hazard_free]
        counts = {"recordings": len(self.trials), "approaches": len(self.trials) - len(calm)}
        return {**counts, "hazard_free": len(calm), "hazard_free_hours": sum(calm) * HOP_S / SECONDS_PER_HOUR}

    @property
    def basis(self) -> str:
        """What the figures stand on, as a sentence."""
        of = self.stands_on
        return (
            f"{of['recordings']:.0f} recordings: {of['approaches']:.0f} approaches and "
            f"{of['hazard_free']:.0f} hazard-free, {of['hazard_free_hours']:.3f} h."
        )

    @property
    def cautions(self) -> tuple[str, ...]:
        """What to say beside figures from so few approaches or hazard-free recordings."""
        calm = sum(trial.hazard_free for trial in self.trials)
        # Either kind by itself: no number of approaches makes the false alarms of three recordings readable.
        kinds = {"approaches": len(self.trials) - calm, "hazard-free recordings": calm}
        return tuple(said for what, count in kinds.items() if (said := caution(count, what)) is not None)


def run_protocol(
    protocol: Protocol,
    trials: Sequence[Trial],
    methods: Sequence[Method],
    classifiers: Classifiers,
    seeds: Sequence[int],
    on_part: Callable[[], None] = lambda: None,
) -> ProtocolRun:
    """Fit and ask all methods on all folds, for every seed; by junction the first seed is the only one.

    The trials are those of the ego motion that the protocol is about.
    """
    # Junctions are not drawn: another seed would give the same folds.
    used = tuple(seeds[:1]) if protocol.by_junction else tuple(seeds)
    passes: list[dict[str, dict[int, Decisions]]] = []
    for seed in used:
        said: dict[str, dict[int, Decisions]] = {method.name: {} for method in methods}
        for calibration, tested in protocol.parts(trials, np.random.default_rng(seed)):
            _one_part(protocol, trials, methods, classifiers, calibration, tested, seed, said)
            on_part()
        passes.append(said)
    rows = sorted(next(iter(passes[0].values())))
    return ProtocolRun(
        protocol,
        tuple(trials[i] for i in rows),
        {
            method.name: tuple(tuple(one[method.name][i] for i in rows) for one in passes)
            for method in methods
        },
        used,
        classifiers.trained_on(protocol.trained_on),
    )


def _one_part(
    protocol: Protocol,
    heard: Sequence[Trial],
    methods: Sequence[Method],
    classifiers: Classifiers,
    calibration: Sequence[int],
    tested: Sequence[int],
    seed: int,
    said: Mapping[str, dict[int, Decisions]],
) -> None:
    before, after = [heard[i] for i in calibration], [heard[i] for i in tested]
    known = classifiers.classify([*before, *after], protocol.trained_on, before, after, seed)
    for method in methods:
        decide = method.fit(known[: len(before)], np.random.default_rng(seed))
        for i, trial in zip(tested, known[len(before) :], strict=True):
            said[method.name][i] = decide(trial)
