"""The methods that are compared, in the order of Table I; a new one joins by a line."""

from collections.abc import Sequence

from worldstate_lab.trials.trial import Method, Trial

from .acoustic_rules import CalibratedCue, PublishedRule, ShippedChain
from .line_of_sight import OcSortRecovery, RadarFieldOfView, VisionOnly

METHODS: tuple[Method, ...] = (
    VisionOnly(),
    RadarFieldOfView(),
    OcSortRecovery("stock"),
    OcSortRecovery("coasting"),
    PublishedRule("published"),
    PublishedRule("published, sustained", sustained=True),
    CalibratedCue("proposed .01", 0.01),
    CalibratedCue("proposed .02", 0.02),
    CalibratedCue("proposed .05", 0.05),
    CalibratedCue("proposed .01 + looming", 0.01, looming=True),
    CalibratedCue("proposed .02 + looming", 0.02, looming=True),
    CalibratedCue("proposed .05 + looming", 0.05, looming=True),
    CalibratedCue("with absence .01", 0.01, absence=True),
    CalibratedCue("with absence .02", 0.02, absence=True),
    CalibratedCue("with absence .05", 0.05, absence=True),
    CalibratedCue("with absence .02 + looming", 0.02, looming=True, absence=True),
    PublishedRule("ensemble, sustained", sustained=True, evidence="ensemble"),
    CalibratedCue("ensemble .02", 0.02, absence=True, evidence="ensemble"),
    CalibratedCue("ensemble .05", 0.05, absence=True, evidence="ensemble"),
    ShippedChain("shipped model", "shipped"),
    ShippedChain("+ site adaptation", "adapted"),
    ShippedChain("world-state advisory", "filtered"),
    ShippedChain("+ ego-noise cancellation", "ego_noise"),
)
# Ablation of the approach rate in the grounded likelihood, eq. (5), and looming as a weight beside it.
GROUNDED: tuple[Method, ...] = (
    CalibratedCue("shipped scores .02", 0.02, absence=True, evidence="shipped"),
    CalibratedCue("grounded .02", 0.02, absence=True, evidence="grounded"),
    CalibratedCue("grounded without approach rate .02", 0.02, absence=True, evidence="rateless"),
)
# The operating curve: budgets of the proposed method beside those of the table.
CURVE_ALPHAS = (0.0, 0.005, 0.01, 0.02, 0.035, 0.05, 0.075, 0.1, 0.15, 0.2)


def methods_for(trials: Sequence[Trial]) -> tuple[Method, ...]:
    """Return the rows that can be formed of these trials: a chain that nothing was heard with has none."""
    heard = set.intersection(*(set(trial.chains) for trial in trials)) if trials else set()
    refused = refused_methods(trials)
    curve = tuple(CalibratedCue(f"curve {alpha:g}", alpha) for alpha in CURVE_ALPHAS)
    return tuple(
        method
        for method in (*METHODS, *GROUNDED, *curve)
        if method.name not in refused and (not isinstance(method, ShippedChain) or method.chain in heard)
    )


def refused_methods(trials: Sequence[Trial]) -> dict[str, str]:
    """Return by row that is not scored why the model was not made for the sound of a recording."""
    refused = {key: why for trial in trials for key, why in trial.refused.items()}
    return {
        method.name: refused[said_by]
        for method in (*METHODS, *GROUNDED)
        if (said_by := _said_by(method)) in refused
    }


def _said_by(method: Method) -> str:
    """Return the chain or the scores that a row is formed of."""
    return method.chain if isinstance(method, ShippedChain) else str(getattr(method, "evidence", ""))
