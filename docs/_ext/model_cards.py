"""Write docs/reference/models.md, the cards of the models that ship: `make cards`."""

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from worldstate.adapters.files.array_file import shipped_models
from worldstate.adapters.files.model_file import read_model
from worldstate.cli.model.show import model_card

PAGE = Path(__file__).resolve().parents[1] / "reference" / "models.md"
HEAD = """# Cards of the models that ship

Every model is for one array, and its file contains its card: `worldstate model show NAME` prints it in full,
without a name that of `standing`. `standing` and `moving` are for the 56 microphones of OVAD; the motion of
the own vehicle selects one. The array selects every other model. `make cards` writes this page.

## Simulated exam

None of these figures is from a real street; [the evaluation](../evidence/evaluation.md) has the real ones. A
vehicle is announced if an advisory begins before it comes into view. The lead is the mean time in between; a
missed vehicle has a lead of 0 s.

| model | microphones | approaches | announced | lead, s | false alarms per hour | bicycles announced |
|---|---|---|---|---|---|---|
"""


def exam_row(name: str, card: dict) -> str:
    """Return the row of one model in the table of the exam."""
    exam = card.get("simulated_exam")
    if not exam:
        return f"| `{name}` | {card['microphones']} | no exam | | | | |\n"
    bicycles = next(one for one in card["kinds"] if one["kind"] == "bicycle")
    cells = f"{exam['approaches']:.0f} | {100 * exam['detected']:.0f} % | {exam['lead_missed_as_0_s']:.1f} | "
    cells += f"{exam['onsets_per_hour']:.0f} | {100 * bicycles['detected']:.0f} % of {bicycles['approaches']}"
    return f"| `{name}` | {card['microphones']} | {cells} |\n"


def parts(cards: dict[str, dict]) -> Iterator[str]:
    """Yield the parts of the page."""
    yield HEAD
    sources, limits = defaultdict(list), defaultdict(list)
    for name, card in cards.items():
        yield exam_row(name, card)
        unlisted = [{"name": card["data"], "use": "coefficients", "licence": "none stated"}]
        for one in card["sources"] or unlisted:
            sources[one["name"], one["use"], one["licence"]].append(f"`{name}`")
        for limit in card["limits"]:
            limits[limit].append(f"`{name}`")
    yield "\n## Training data\n\n| source | used for | licence | models |\n|---|---|---|---|\n"
    for source, names in sources.items():
        yield f"| {' | '.join(source)} | {listed(names, cards)} |\n"
    yield "\n## Limits and licence\n\n| limit | models |\n|---|---|\n"
    for limit, names in limits.items():
        yield f"| {limit} | {listed(names, cards)} |\n"
    yield f"\nLicence: {cards['standing']['licence']}.\n"


def listed(names: list[str], cards: dict[str, dict]) -> str:
    """Return the names of models, or the names of those that are missing."""
    others = [f"`{name}`" for name in cards if f"`{name}`" not in names]
    if len(others) < len(names):
        return " but ".join(["all", *([", ".join(others)] if others else [])])
    return ", ".join(names)


def page() -> str:
    """Return the page."""
    return "".join(parts({name: model_card(read_model(name)) for name in shipped_models()}))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
