"""`worldstate model show`: print the card of a model.

Print the origin and the domain of a model: data, recordings, array, band, feature, ego motion, thresholds,
limits and licence.

Examples
--------
  worldstate model show
  worldstate model show my_model.json --json
"""

import argparse
from dataclasses import asdict
from pathlib import Path

from worldstate import adapters
from worldstate.cli.common import output
from worldstate.frontend.array.microphone_array import nearest_spacings_m

# The training data of a user has a licence of its own.
LICENCE = "Apache-2.0 for the coefficients that ship; no row of the training data is in the file"
SHOWN = (3.0, 6.0, 12.0, 25.0, 50.0, 100.0)  # Budgets, false alarms per hour
UNNAMED = "names no array, sample rate or ego motion: no budget is stated with it"
# Text of each row of the card.
_ROWS = {
    "sources": "{name}: {use}; licence: {licence}",
    "real_figures": "{sentence}",
    "kinds": "{kind}: {detected:.2f} of {approaches} simulated approaches raised an advisory",
    "street": "{name} {value:g} {unit} ({origin}: {why})",
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    told = "model file, or the name of a shipped model (default: the first one)"
    parser.add_argument("file", type=Path, nargs="?", metavar="FILE", help=told)


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.source import NO_STREET

    model = adapters.read_model(arguments.file)
    if model.street is None:
        output.say(NO_STREET)
    card = model_card(model)
    return output.CommandResult(card, table=readable(card))


def readable(card: dict[str, object]) -> dict[str, object]:
    """Return the card with one line per threshold and limit."""
    lines: dict[str, object] = {}
    for key, value in card.items():
        if isinstance(value, dict) and key == "street":
            value = [{"name": name} | one for name, one in value.items()]
        if isinstance(value, list) and key in (*_ROWS, "budgets", "thresholds", "limits"):
            rows = [_ROWS[key].format(**one) if key in _ROWS else _words(one) for one in value]
            lines |= {f"{key.removesuffix('s')} {number}": row for number, row in enumerate(rows, start=1)}
        else:
            lines[key] = _words(value)
    return lines


def _words(value: object) -> object:
    if isinstance(value, dict):
        return "  ".join(f"{key} {part:.4g}" for key, part in value.items()) or None
    return value


def model_card(model: "adapters.Model") -> dict[str, object]:
    """Return the card of a model as JSON-able values.

    Examples
    --------
    >>> from worldstate.adapters.files.model_file import read_model
    >>> card = model_card(read_model())
    >>> card["microphones"], card["ego_motion"]
    (56, 'standing')
    """
    origin = model.provenance
    real = [one for one in origin.real if one.own] or origin.real
    return {
        "data": origin.dataset,
        "group": origin.group,
        "recordings": len(origin.training_recordings),
        "sites": sorted({key.split("/")[0] for key in origin.training_recordings}),
        "excluded_lists": list(origin.excluded_lists),
        "classifier": origin.classifier,
        "sources": [asdict(one) for one in origin.sources],
        **_made_for(model),
        **_budgets(model),
        "thresholds": [
            {"alpha": one.alpha, "beta": one.miss_rate, "gamma": one.gamma, "sustain_hops": one.sustain_hops}
            for one in model.policies.policies
        ],
        "figures": dict(origin.figures),
        "simulated_exam": dict(origin.exam),
        "real_figures": [asdict(one) | {"sentence": one.sentence} for one in real],
        "kinds": [asdict(one) for one in origin.kinds],
        "street": {} if model.street is None else {k: asdict(v) for k, v in model.street.described.items()},
        "limits": _limits(model),
        "licence": LICENCE,
    }


def _made_for(model: "adapters.Model") -> dict[str, object]:
    domain = model.domain
    if domain is None:
        return {"array": None}
    return {
        "array": domain.array,
        "microphones": len(domain.positions_m),
        "spacing_mm": round(1e3 * float(nearest_spacings_m(domain.positions_m).mean()), 1),
        "extent_m": [round(extent, 3) for extent in domain.extent_m],
        "band_hz": list(domain.band_hz),
        "feature": domain.feature,
        "ego_motion": domain.ego_motion,
    }


def _budgets(model: "adapters.Model") -> dict[str, object]:
    """Return the row of the curve for the default budget, and for some others."""
    sequence = model.sequence
    if sequence is None or sequence.alarm is None:
        return {}
    default, curve = sequence.alarm.onsets_per_hour, sequence.curve
    if curve is None:
        return {"default_budget": default, "budgets": []}
    least, most = curve.least_onsets / curve.hours, float(curve.onsets_per_hour[-1])
    promised = {asked: curve.default(asked).promise for asked in SHOWN if least <= asked <= most}
    rows = [{"asked": asked} | asdict(one) for asked, one in promised.items() if one is not None]
    return {"default_budget": default, "budget_hours": curve.hours, "budgets": rows}


def _limits(model: "adapters.Model") -> list[str]:
    """Return the limits of the model."""
    from worldstate.adapters.files.acoustic_domain import UNFIT
    from worldstate.frontend.direction.feature import LEAST_RATE_HZ

    domain, unfit = model.domain, [] if model.provenance.fit_for_use else [f"{UNFIT}: no budget is stated"]
    if domain is None:
        return [*unfit, UNNAMED]
    limits = [
        "another array: refused; microphones more than 1 mm elsewhere count as another",
        f"sound of a sample rate below {LEAST_RATE_HZ:.0f} Hz: refused",
        "other sites than those named: thresholds were set on these; see worldstate model threshold",
        "sound of anything but vehicles: the model does not know it",
    ]
    if domain.ego_motion != "any":
        other = "moving" if domain.ego_motion == "standing" else "standing"
        limits.insert(2, f"a {other} ego: no budget is stated")
    if domain.fastest_mps is not None:
        limits.insert(2, f"an ego faster than {domain.fastest_mps:.1f} m/s by odometry: nothing is read")
    return [*unfit, *limits]
