"""Figures of the pages, each taken by name from what the laboratory wrote: `make figures`.

`docs/evidence/results.json` holds what `worldstate-lab ... --results` kept, `docs/evidence/figures.csv` gives
a figure a name: the key of its command, where it stands in the report, and how it is written. On a page a
name in a comment follows the figure: ``.983 <!-- standing.auroc -->``. Two pages cannot differ.
"""

import csv
import json
import re
from functools import reduce
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1]
EVIDENCE = DOCS / "evidence"
# A figure, perhaps with its interval, and its name.
_NAMED = re.compile(r"[-\d.]+(?: \[[^\]]*\])? <!-- ([\w.]+) -->")


def rows() -> list[dict[str, str]]:
    """Return the lines of the table of names."""
    with (EVIDENCE / "figures.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def written(row: dict[str, str], results: dict[str, Any]) -> str:
    """Return a figure as a page shows it: without the zero before its point, its interval behind it."""
    found = results[row["key"]]["figures"]
    ends = (row["at"], *filter(None, (row["low"], row["high"])))
    values = [reduce(_inside, path.split("/"), found) for path in ends]
    figure, *interval = (_plain(float(value), int(row["digits"])) for value in values)
    return f"{figure} [{', '.join(interval)}]" if interval else figure


def _inside(held: Any, name: str) -> Any:
    return held[int(name)] if isinstance(held, list) else held[name]


def _plain(value: float, digits: int) -> str:
    return re.sub(r"^(-?)0\.", r"\1.", f"{value:.{digits}f}")


def page_of_results(results: dict[str, Any]) -> str:
    """Return the page that lists every figure with its sample and command."""
    lines = [
        "# Results\n",
        "Every figure that has a name on other pages, with the command that made it. Intervals are 95 %.\n",
        "| figure | value | sample | command | commit |",
        "|---|---|---|---|---|",
    ]
    for row in rows():
        made = results[row["key"]]
        by = f"`{made['command']}`", str(made["commit"])[:8]
        cells = row["what"], written(row, results), row["sample"], *by
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def pages() -> dict[Path, str]:
    """Return the text of every page with figures, as the results say it."""
    results = json.loads((EVIDENCE / "results.json").read_text(encoding="utf-8"))
    figures = {row["name"]: written(row, results) for row in rows()}
    texts = {EVIDENCE / "results.md": page_of_results(results)}
    for page in (DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md"))):
        text = page.read_text(encoding="utf-8")
        if _NAMED.search(text):
            texts[page] = _NAMED.sub(lambda at: f"{figures[at[1]]} <!-- {at[1]} -->", text)
    return texts


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
