"""Model files: versioned JSON that holds coefficients only."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from worldstate.abduction.cueing.cueing_policy import CueingPolicies, CueingPolicy
from worldstate.abduction.signature.signature_io import AnySignature, signature_from_dict
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.reading import decode_json
from worldstate.ground.schema import check_schema, read_number, schema_stamp

from .atomic import write_text

SCHEMA = "worldstate.Model"
VERSION = "1.1.0"
MAX_BYTES = 16 << 20
MOST_POLICIES = 1000
MOST_NAMES = 1_000_000


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a model comes from.

    Parameters
    ----------
    dataset : str
        Name of the data that it was trained on.
    group : str
        Which part of it: static, dynamic or all.
    classifier : str
        What was trained.
    scikit_learn : str
        Version that trained it.
    seed : int
        Of the generator that drew folds.
    training_recordings : tuple of str
        Environment and recording, as ``SA1/34``: an evaluation refuses to score these.
    excluded_lists : tuple of str
        Names of the lists whose recordings were left out.
    figures : mapping of str to float
        What out-of-fold windows scored during training.

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
    figures: Mapping[str, float] | None = None


@dataclass(frozen=True, slots=True)
class Model:
    """All that a trained model holds.

    Parameters
    ----------
    signature : SignatureModel or EnsembleModel
        From features to likelihoods.
    policies : CueingPolicies
        Threshold, sustained rule and risk map for each budget.
    provenance : Provenance
        Where it comes from.
    """

    signature: AnySignature
    policies: CueingPolicies
    provenance: Provenance


def load_model(path: str | Path | None = None) -> tuple[AnySignature, CueingPolicies]:
    """Read what inference needs; without a path, of the model that ships with the package.

    Parameters
    ----------
    path : str or Path, optional
        JSON file.

    Returns
    -------
    signature, policies : SignatureModel or EnsembleModel, and CueingPolicies
        Ready to use.

    Raises
    ------
    InputFileError
        As `read_model`.
    """
    model = read_model(path)
    return model.signature, model.policies


def read_model(path: str | Path | None = None) -> Model:
    """Read a model; without a path, the one that ships with the package.

    Parameters
    ----------
    path : str or Path, optional
        JSON file.

    Returns
    -------
    Model
        With its provenance.

    Raises
    ------
    InputFileError
        If the file is missing, too large, truncated or no JSON, or a number is missing, not finite or out of
        range.
    SchemaVersionError
        If it is of another major version.

    Examples
    --------
    >>> read_model().signature.classes
    ('front', 'left', 'none', 'right')
    """
    if path is not None:
        return model_from_dict(_decoded(Path(path)), path)
    with as_file(files("worldstate") / "data" / "default_model.json") as default:
        return model_from_dict(_decoded(default), default.name)


def save_model(path: str | Path, model: Model) -> None:
    """Write a model to exactly this path, whole or not at all.

    Parameters
    ----------
    path : str or Path
        Exactly this file.
    model : Model
        What to write.

    Raises
    ------
    InputFileError
        If the folder is missing.
    """
    lines = [f"{json.dumps(k)}: {json.dumps(v, allow_nan=False)}" for k, v in model_to_dict(model).items()]
    write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


def model_to_dict(model: Model) -> dict[str, Any]:
    """Return JSON-able values."""
    origin = model.provenance
    return {
        **schema_stamp(SCHEMA, VERSION),
        "provenance": {
            "dataset": origin.dataset,
            "group": origin.group,
            "classifier": origin.classifier,
            "scikit_learn": origin.scikit_learn,
            "seed": origin.seed,
            "training_recordings": list(origin.training_recordings),
            "excluded_lists": list(origin.excluded_lists),
            "figures": dict(origin.figures or {}),
        },
        "signature": model.signature.to_dict(),
        "policies": [policy.to_dict() for policy in model.policies.policies],
    }


def model_from_dict(data: object, source: object) -> Model:
    """Return the model that `model_to_dict` wrote; unknown keys are ignored."""
    fields = check_schema(data, SCHEMA, VERSION, source)
    try:
        policies = _list(fields.get("policies"), "policies", MOST_POLICIES)
        return Model(
            signature_from_dict(fields.get("signature")),
            CueingPolicies(tuple(CueingPolicy.from_dict(policy) for policy in policies)),
            _provenance(_mapping(fields.get("provenance"), "provenance")),
        )
    except InvalidArgumentError as error:
        raise InputFileError(source, str(error)) from error


def _decoded(path: Path) -> object:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputFileError(path, f"expected a model file ({error.strerror})") from error
    if len(data) > MAX_BYTES:
        raise InputFileError(path, f"expected a model file of at most {MAX_BYTES >> 20} MiB")
    try:
        return decode_json(data.decode("utf-8"), "model")
    except UnicodeDecodeError as error:
        raise InputFileError(path, "expected a model file in UTF-8") from error
    except InvalidArgumentError as error:
        raise InputFileError(path, str(error)) from error


def _provenance(fields: Mapping[str, object]) -> Provenance:
    seed = fields.get("seed")
    if not isinstance(seed, int) or isinstance(seed, bool):
        raise InvalidArgumentError("seed: expected a whole number")
    figures = _mapping(fields.get("figures", {}), "figures")
    return Provenance(
        dataset=_text(fields, "dataset"),
        group=_text(fields, "group"),
        classifier=_text(fields, "classifier"),
        scikit_learn=_text(fields, "scikit_learn"),
        seed=seed,
        training_recordings=_texts(fields, "training_recordings"),
        excluded_lists=_texts(fields, "excluded_lists"),
        figures={str(name): read_number(value, str(name)) for name, value in figures.items()},
    )


def _mapping(value: object, name: str) -> Mapping[str, object]:
    if not isinstance(value, Mapping):
        raise InvalidArgumentError(f"{name}: expected an object, got {type(value).__name__}")
    return value


def _list(value: object, name: str, most: int) -> list[object]:
    if not isinstance(value, list) or len(value) > most:
        raise InvalidArgumentError(f"{name}: expected a list of at most {most} items")
    return value


def _text(fields: Mapping[str, object], name: str) -> str:
    value = fields.get(name)
    if not isinstance(value, str):
        raise InvalidArgumentError(f"{name}: expected text, got {type(value).__name__}")
    return value


def _texts(fields: Mapping[str, object], name: str) -> tuple[str, ...]:
    values = _list(fields.get(name), name, MOST_NAMES)
    if not all(isinstance(value, str) for value in values):
        raise InvalidArgumentError(f"{name}: expected a list of text")
    return tuple(str(value) for value in values)
