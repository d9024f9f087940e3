"""Methods and baselines of an evaluation on feature windows."""

from dataclasses import replace

import numpy as np

from worldstate.abduction.signature.ensemble_training import Recipe, SimulatedWindows, SiteEnsembleClassifier
from worldstate.operations.training.training import PUBLISHED_MISS_RATE
from worldstate_lab.features.published_classifier import Classifier, PublishedClassifier

from .feature_evaluation import Protocol, Reference, WindowMethod

REFERENCES: tuple[Reference, ...] = ("run", "cold", "curated")


def _distant_site(rng: np.random.Generator) -> Classifier:
    # Only the quiet reference is used, with weak regularisation. A stronger ridge favours the level, which is
    # masked by the noise of a moving ego; the pattern relative to the quietest windows remains. The recipe
    # was chosen among about thirty, for each moving junction on the other two, with the same result three
    # times.
    return SiteEnsembleClassifier((Recipe("quiet", 1e-5),))


def methods(simulated: SimulatedWindows | None = None) -> dict[str, WindowMethod]:
    """Return the methods by name; with simulated windows, the ensembles are trained on them too."""
    ensemble = WindowMethod(simulated=simulated)
    # For a moving ego only the pattern is used, because streets with a standing ego reduce its accuracy
    # (lab/NOTES.md).
    distant = WindowMethod(_distant_site, afar=True)
    return {
        "baseline": WindowMethod(PublishedClassifier, PUBLISHED_MISS_RATE),
        **{f"ensemble_{one}": replace(ensemble, reference=one) for one in REFERENCES},
        **{f"distant_site_{one}": replace(distant, reference=one) for one in REFERENCES},
    }


# The method of `worldstate`: the ensemble if the ego moves as in training, a single expert otherwise. The
# choice depends only on the known motion of the ego.
OURS: dict[Protocol, str] = {"cv": "ensemble", "lojo": "ensemble", "transfer": "distant_site"}


def row_of(method: str, protocol: Protocol, reference: Reference) -> str:
    """Return the name in `methods` of a method under a protocol and a reference."""
    return f"{OURS[protocol]}_{reference}" if method == "worldstate" else method


def rows_beside(row: str, protocol: Protocol, reference: Reference) -> tuple[str, ...]:
    """Return the rows to compare with one: baselines, and the same method with the other references."""
    if row == "baseline":
        return ()
    others = tuple(row_of("worldstate", protocol, other) for other in REFERENCES if other != reference)
    # If the motion of the ego differs from training, the ensemble is a baseline too.
    afar = (f"ensemble_{reference}",) if protocol == "transfer" else ()
    return ("baseline", *others, *afar)


def method_of(method: str) -> WindowMethod:
    """Return a method as used in training: with curated references."""
    return methods()[row_of(method, "cv", "curated")]
