"""Model files: versioned JSON that contains only coefficients."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from worldstate.abduction.cueing.cueing_policy import CueingPolicies, CueingPolicy
from worldstate.abduction.road_users import DomainGuard, RoadUserModel
from worldstate.abduction.sequence.sequence_model import SequenceModel
from worldstate.abduction.signature.ensemble import AnySignature
from worldstate.abduction.signature.published_signature import ModelDomain
from worldstate.belief.street_model import StoredStreet, StreetModel
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import ADDED, Count, Layout, Probability, Via, encode

from .array_file import file_of_model
from .file_io import read_record, refused_as_file, write_text

# Largest number allowed in a model file. The largest in shipped models is a sample rate; a squared sum of
# thousands of products of two numbers up to this limit is still finite.
LARGEST = 1e12


@dataclass(frozen=True, slots=True)
class DataSource:
    """Data with which a model was made or evaluated, and their licence."""

    name: str
    use: Literal["coefficients", "thresholds", "exam"]
    licence: str = "none stated"


@dataclass(frozen=True, slots=True)
class KindShare:
    """Share of approaches of one kind of road user with an advisory in the simulated evaluation."""

    kind: str
    detected: Probability
    approaches: Count


@dataclass(frozen=True, slots=True)
class RealFigure:
    """A figure of a simulated evaluation, and the same figure on real recordings.

    Parameters
    ----------
    figure : str
        Its name in words.
    simulated, real : float
        Values on simulated streets and on the recordings, for the model that was evaluated on the recordings.
    low, high : float
        95 % interval of the real value.
    array : str
        Array with these microphones.
    microphones, recordings : int
        Number of microphones and of recordings.
    source : str
        Command and version of the measurement.
    own : bool
        Whether the model is for this array and a standing ego, as in the recordings; otherwise no real
        recording exists for the model.

    Examples
    --------
    >>> gap = RealFigure("AUROC", 0.98, 0.75, 0.61, 0.87, "a car's roof", 2, 45, "-")
    >>> gap.sentence
    "no real recording of such an array and motion; AUROC: 0.98 in simulation was 0.75 [0.61, 0.87] in 45..."
    """

    figure: str
    simulated: float
    real: float
    low: float
    high: float
    array: str
    microphones: Count
    recordings: Count
    source: str
    own: bool = False

    @property
    def sentence(self) -> str:
        """The figure in one sentence."""
        interval = f"{self.real:.2f} [{self.low:.2f}, {self.high:.2f}]"
        made = f"{self.recordings} real recordings with {self.microphones} microphones of {self.array}"
        was = f"{self.figure}: {self.simulated:.2f} in simulation was {interval} in {made}"
        return was if self.own else f"no real recording of such an array and motion; {was}"


@dataclass(frozen=True, slots=True)
class Provenance:
    """Origin of a model.

    Parameters
    ----------
    dataset : str
        Name of the training data.
    group : str
        Part of the data: static, dynamic or all.
    classifier : str
        Type of the trained classifier.
    scikit_learn : str
        Version used for training.
    seed : int
        Seed of the generator of folds.
    training_recordings : tuple of str
        Environment and recording, such as ``SA1/34``; an evaluation refuses to score these.
    excluded_lists : tuple of str
        Names of the lists of excluded recordings.
    figures : mapping of str to float
        Scores of out-of-fold windows during training.
    fit_for_use : bool
        False for a model that was made to try out a command: it guarantees no budget.
    sources : tuple of DataSource
        Each source with its use and licence; empty in files of a version before 1.8.
    exam : mapping of str to float
        Results of the simulated evaluation; empty without one and in files of a version before 1.9.
    kinds : tuple of KindShare
        Number of approaches in the evaluation and detected share, per kind of road user.
    real : tuple of RealFigure
        Figures of a simulated evaluation on real recordings, of this array if available, otherwise of others.

    Examples
    --------
    >>> Provenance("OVAD", "static", "linear", "1.9.1", 0, ("SA1/34",)).excluded_lists
    ()
    """

    dataset: str
    group: str
    classifier: str
    scikit_learn: str
    seed: int
    training_recordings: tuple[str, ...]
    excluded_lists: tuple[str, ...] = ()
    figures: Mapping[str, float] = field(default_factory=dict)
    fit_for_use: bool = field(default=True, metadata=ADDED)
    sources: tuple[DataSource, ...] = field(default=(), metadata=ADDED)
    exam: Mapping[str, float] = field(default_factory=dict, metadata=ADDED)
    kinds: tuple[KindShare, ...] = field(default=(), metadata=ADDED)
    real: tuple[RealFigure, ...] = field(default=(), metadata=ADDED)


@dataclass(frozen=True, slots=True)
class Model:
    """A trained model with all its parts.

    Parameters
    ----------
    signature : SignatureModel or EnsembleModel
        Maps features to likelihoods.
    policies : CueingPolicies
        Threshold and risk map per budget.
    provenance : Provenance
        Origin of the model.
    sequence : SequenceModel, optional
        Estimates the sides from which a vehicle comes, and when, from seconds of the signature's evidence.
    street : StreetModel, optional
        Parameters of the belief about the approach sides. None in files of a version before 1.7, for which
        the shipped parameters are used.

    Examples
    --------
    >>> model = read_model()
    >>> sorted({policy.alpha for policy in model.policies.policies})
    [0.01, 0.02, 0.05]
    """

    LAYOUT: ClassVar = Layout(
        "worldstate.Model", "1.9.0", order="provenance signature policies sequence guard road_users street"
    )

    signature: AnySignature
    policies: Annotated[CueingPolicies, Via(tuple[CueingPolicy, ...], attrgetter("policies"), CueingPolicies)]
    provenance: Provenance
    sequence: SequenceModel | None = field(default=None, metadata=ADDED)
    guard: DomainGuard | None = field(default=None, metadata=ADDED)
    road_users: RoadUserModel | None = field(default=None, metadata=ADDED)
    street: StoredStreet | None = field(default=None, metadata=ADDED)

    @property
    def domain(self) -> ModelDomain | None:
        """Domain of the model; None in files of a version before 1.2."""
        return self.signature.domain


def read_model(
    path: str | Path | None = None, *, moving_ego: bool = False, array: MicrophoneArray | None = None
) -> Model:
    """Read a model; by default the one that ships with the package.

    Parameters
    ----------
    path : str or Path, optional
        JSON file, compressed if its name ends in .gz, or the name of a shipped model; the command
        `worldstate model list` prints the names.
    moving_ego : bool
        Use the roof-array model for a moving ego instead of the one for a standing ego.
    array : MicrophoneArray, optional
        Array of the recording. The shipped model for a board with these microphones is read, if there is one.

    Raises
    ------
    InputFileError
        If the file is missing, too large, truncated or not JSON, or a number is missing, not finite, above
        1e12 or out of range.
    SchemaVersionError
        If the file has another major version.

    Examples
    --------
    >>> [read_model(moving_ego=moving).domain.ego_motion for moving in (False, True)]
    ['standing', 'moving']
    """
    file = file_of_model(path, array, moving_ego=moving_ego)
    if path is not None and file == Path(path):
        model = read_record(Model, path, "model")
        with refused_as_file(path):
            for name in ("signature", "policies", "sequence", "guard", "road_users"):
                if not (most := _largest(getattr(model, name))) <= LARGEST:
                    raise InvalidArgumentError(f"{name}: expected numbers up to {LARGEST:g}, got {most:g}")
        return model
    shipped = _shipped(file)
    # Only these parts are mutable, so they are copied.
    origin = shipped.provenance
    own = replace(origin, figures=dict(origin.figures), exam=dict(origin.exam))
    return replace(shipped, provenance=own, street=StreetModel())


def _largest(value: Any) -> float:
    """Return the largest magnitude in a part; products of numbers above `LARGEST` may overflow."""
    if isinstance(value, int | float | np.ndarray):
        return float(np.max(np.abs(value), initial=0.0))
    parts = value if isinstance(value, tuple) else ()
    if is_dataclass(value):
        parts = tuple(getattr(value, one.name) for one in fields(value) if one.init)
    return max(map(_largest, value.values() if isinstance(value, Mapping) else parts), default=0.0)


@cache
def _shipped(path: Path) -> Model:
    # Cached, because reading takes a quarter of a second.
    return read_record(Model, path, "model")


def save_model(path: str | Path, model: Model) -> None:
    """Write a model to a file, atomically; compressed if the name ends in .gz.

    Raises
    ------
    InputFileError
        If the folder is missing.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_model(Path(folder) / "copy.json", read_model())
    ...     read_model(Path(folder) / "copy.json").provenance == read_model().provenance
    True
    """
    lines = [f"{json.dumps(k)}: {json.dumps(v, allow_nan=False)}" for k, v in encode(model).items()]
    write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")
