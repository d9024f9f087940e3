"""Split of recordings into calibration and test, and every method fitted and applied on each split."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import SECONDS_PER_HOUR
from worldstate.operations.metrics.approach_table import caution
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate_lab.methods.acoustic_rules import CalibratedCue, PublishedRule, ShippedChain
from worldstate_lab.methods.line_of_sight import OcSortRecovery, RadarFieldOfView, VisionOnly
from worldstate_lab.metrics.intervals import deal_folds
from worldstate_lab.trials.classification import Classifiers, TrainedOn, junction_of
from worldstate_lab.trials.trial import Decisions, Method, Take, Trial

FOLDS = 5


@dataclass(frozen=True, slots=True)
class Protocol:
    """One way to split recordings into calibration and test."""

    name: str
    title: str
    moving: bool = False  # Whether it uses the recordings with a moving ego
    by_junction: bool = False  # Leave one junction out instead of folds over recordings
    trained_on: TrainedOn = "all"  # Training data of the published classifier

    def lacks(self, takes: Sequence[Take]) -> str | None:
        """Return what is missing for this protocol, or None, without processing a recording."""
        chosen = [take for take in takes if take.moving == self.moving]
        calm = sum(take.hazard_free for take in chosen)
        kinds = {"approaches with a T0": len(chosen) - calm, "hazard-free recordings": calm}
        wanted = [f"2 {name}, found {count}" for name, count in kinds.items() if count < 2]
        both = junctions_with_both([(take.site, take.hazard_free) for take in chosen])
        if self.by_junction and len(both) < 2:
            wanted.append(f"2 junctions with approaches and hazard-free recordings, found {len(both)}")
        ego = "moving" if self.moving else "standing"
        return f"needs, with a {ego} ego, " + " and ".join(wanted) if wanted else None

    def parts(
        self, trials: Sequence[Trial], rng: np.random.Generator
    ) -> Iterator[tuple[list[int], list[int]]]:
        """Yield rows of calibration and test recordings; every recording is a test recording once."""
        sites = [trial.site for trial in trials]
        if self.by_junction:
            names = junctions_with_both([(trial.site, trial.hazard_free) for trial in trials])
            # -1 if one kind of recordings is missing at the junction.
            fold_of = np.array([names.index(j) if (j := junction_of(one)) in names else -1 for one in sites])
        else:
            fold_of = deal_folds([trial.label for trial in trials], sites, rng, FOLDS)
        for fold in np.unique(fold_of[fold_of >= 0]).tolist():
            calibration = np.flatnonzero(fold_of != fold).tolist()
            tested = np.flatnonzero(fold_of == fold).tolist()
            shared = {trials[i].name for i in calibration} & {trials[i].name for i in tested}
            if shared:
                raise InvalidArgumentError(f"recordings: {sorted(shared)[0]} both calibrates and is tested")
            yield calibration, tested


STATIC = Protocol("static", "Standing ego, five folds")
STANDING = STATIC.name  # Protocol of most sections of the report
DYNAMIC = Protocol("dynamic", "Moving ego, five folds", moving=True)
FIXED = Protocol("junctions_fixed", "One junction out, classifier fixed", by_junction=True)
RETRAINED = Protocol(
    "junctions_retrained",
    "One junction out, classifier retrained without it",
    by_junction=True,
    trained_on="other junctions",
)
PROTOCOLS = (STATIC, DYNAMIC, FIXED, RETRAINED)


def junctions_with_both(sites: Sequence[tuple[str, bool]]) -> list[str]:
    """Return the names of the junctions that have both approaches and hazard-free recordings, sorted."""
    kinds: dict[str, set[bool]] = {}
    for site, hazard_free in sites:
        kinds.setdefault(junction_of(site), set()).add(hazard_free)
    return sorted(name for name, found in kinds.items() if len(found) == 2)


@dataclass(frozen=True, slots=True, eq=False)
class ProtocolRun:
    """Decisions of every method on every test recording, for each seed."""

    protocol: Protocol
    trials: tuple[Trial, ...]
    # By method: one pass per seed with one element per trial, in the order of the trials.
    decisions: Mapping[str, tuple[tuple[Decisions, ...], ...]]
    seeds: tuple[int, ...]
    trained_on: str  # Training data of the published classifier

    @property
    def stands_on(self) -> dict[str, float]:
        """Number of scored recordings of either kind, and the hours without a vehicle."""
        calm = [len(trial.hops) for trial in self.trials if trial.hazard_free]
        counts = {"recordings": len(self.trials), "approaches": len(self.trials) - len(calm)}
        return {**counts, "hazard_free": len(calm), "hazard_free_hours": sum(calm) * HOP_S / SECONDS_PER_HOUR}

    @property
    def basis(self) -> str:
        """The data behind the figures, as a sentence."""
        of = self.stands_on
        return (
            f"{of['recordings']:.0f} recordings: {of['approaches']:.0f} approaches and "
            f"{of['hazard_free']:.0f} hazard-free, {of['hazard_free_hours']:.3f} h."
        )

    @property
    def cautions(self) -> tuple[str, ...]:
        """Warnings to print beside figures from few approaches or few hazard-free recordings."""
        calm = sum(trial.hazard_free for trial in self.trials)
        # Each kind is checked alone: many approaches do not help if false alarms come from three recordings.
        kinds = {"approaches": len(self.trials) - calm, "hazard-free recordings": calm}
        return tuple(said for what, count in kinds.items() if (said := caution(count, what)) is not None)


def run_protocol(
    protocol: Protocol,
    trials: Sequence[Trial],
    methods: Sequence[Method],
    classifiers: Classifiers | None,
    seeds: Sequence[int],
) -> ProtocolRun:
    """Fit and apply all methods on all folds for every seed; by junction, only the first seed is used.

    The trials must have the ego motion of the protocol. Without classifiers they keep the scores they have.
    """
    # Junctions are not drawn at random: another seed would give the same folds.
    used = tuple(seeds[:1]) if protocol.by_junction else tuple(seeds)
    passes: list[dict[str, dict[int, Decisions]]] = []
    for seed in used:
        said: dict[str, dict[int, Decisions]] = {method.name: {} for method in methods}
        for calibration, tested in protocol.parts(trials, np.random.default_rng(seed)):
            parts = [trials[i] for i in calibration], [trials[i] for i in tested]
            before, after = classifiers.classify(protocol.trained_on, *parts, seed) if classifiers else parts
            for method in methods:
                decide = method.fit(before, np.random.default_rng(seed))
                said[method.name] |= {i: decide(trial) for i, trial in zip(tested, after, strict=True)}
        passes.append(said)
    rows = sorted(next(iter(passes[0].values())))
    decisions = {
        name: tuple(tuple(one[name][i] for i in rows) for one in passes)
        for name in (method.name for method in methods)
    }
    trained_on = classifiers.trained_on(protocol.trained_on) if classifiers else ""
    return ProtocolRun(protocol, tuple(trials[i] for i in rows), decisions, used, trained_on)


BUDGETS = {".01": 0.01, ".02": 0.02, ".05": 0.05}
METHODS: tuple[Method, ...] = (
    VisionOnly(),
    RadarFieldOfView(),
    OcSortRecovery("stock"),
    OcSortRecovery("coasting"),
    PublishedRule("published"),
    PublishedRule("published, sustained", sustained=True),
    *(CalibratedCue(f"proposed {name}", alpha) for name, alpha in BUDGETS.items()),
    *(CalibratedCue(f"proposed {name} + looming", alpha, looming=True) for name, alpha in BUDGETS.items()),
    *(CalibratedCue(f"with absence {name}", alpha, absence=True) for name, alpha in BUDGETS.items()),
    CalibratedCue("with absence .02 + looming", 0.02, looming=True, absence=True),
    PublishedRule("ensemble, sustained", sustained=True, evidence="ensemble"),
    CalibratedCue("ensemble .02", 0.02, absence=True, evidence="ensemble"),
    CalibratedCue("ensemble .05", 0.05, absence=True, evidence="ensemble"),
    ShippedChain("shipped model", "shipped"),
    ShippedChain("+ site adaptation", "adapted"),
    ShippedChain("world-state advisory", "filtered"),
)
# Ablation of the approach rate in the grounded likelihood, eq. (5); looming as a weight is another row.
GROUNDED: tuple[Method, ...] = (
    CalibratedCue("shipped scores .02", 0.02, absence=True, evidence="shipped"),
    CalibratedCue("grounded .02", 0.02, absence=True, evidence="grounded"),
    CalibratedCue("grounded without approach rate .02", 0.02, absence=True, evidence="rateless"),
)


def methods_for(trials: Sequence[Trial]) -> tuple[Method, ...]:
    """Return the methods that can be scored on these trials; a chain needs results in every trial."""
    heard = set.intersection(*(set(trial.chains) for trial in trials)) if trials else set()
    refused = refused_methods(trials)
    return tuple(
        method
        for method in (*METHODS, *GROUNDED)
        if method.name not in refused and (not isinstance(method, ShippedChain) or method.chain in heard)
    )


def refused_methods(trials: Sequence[Trial]) -> dict[str, str]:
    """Return, by method that is not scored, why its model does not fit the sound of a recording."""
    refused = {key: why for trial in trials for key, why in trial.refused.items()}
    # The chain or the scores that a method uses.
    used = {
        one.name: one.chain if isinstance(one, ShippedChain) else str(getattr(one, "evidence", ""))
        for one in (*METHODS, *GROUNDED)
    }
    return {name: refused[source] for name, source in used.items() if source in refused}
