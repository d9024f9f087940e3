"""Write the pages that contain figures from their templates: `make figures`.

`worldstate-lab ... --results docs/evidence/results.json` stores the figures of a command.
`docs/evidence/figures.csv` gives a figure its name: the key of the command, the path in its report, the ends
of the interval and the number of decimals. The template `docs/templates/evidence/place.md.in` becomes the
page `docs/evidence/place.md`:

- ``{{ standing.auroc }}`` becomes ``0.972 [0.957, 0.985]``,
- ``{{ standing.detected % }}`` becomes ``69 % [66, 73]``,
- ``{{ standing.auroc command }}`` becomes the command of the figure and the commit that it ran on.
"""

import csv
import json
import re
from functools import reduce
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1]
EVIDENCE = DOCS / "evidence"
TEMPLATES = DOCS / "templates"
FIGURE = re.compile(r"\{\{ ([\w.]+)( %| command)? \}\}")


def rows() -> list[dict[str, str]]:
    """Return the rows of the table of names."""
    with (EVIDENCE / "figures.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def written(row: dict[str, str], results: dict[str, Any], form: str = "") -> str:
    """Return a figure with its interval as a page prints it, perhaps in per cent, or its command."""
    made = results[row["key"]]
    if form == " command":
        return f"{made['command']}  # commit {made['commit'][:8]}"
    found = made["figures"]
    ends = (row["at"], *filter(None, (row["low"], row["high"])))
    values = [float(reduce(_inside, path.split("/"), found)) for path in ends]
    digits, factor = int(row["digits"]), 1
    if form == " %":
        digits, factor = max(digits - 2, 0), 100
    figure, *interval = (f"{factor * value:.{digits}f}" for value in values)
    return f"{figure}{form} [{', '.join(interval)}]" if interval else figure + form


def _inside(held: Any, name: str) -> Any:
    return held[int(name)] if isinstance(held, list) else held[name]


def pages() -> dict[Path, str]:
    """Return the text of every page that contains figures."""
    results = json.loads((EVIDENCE / "results.json").read_text(encoding="utf-8"))
    named = {row["name"]: row for row in rows()}
    texts = {}
    for template in sorted(TEMPLATES.rglob("*.md.in")):
        page = template.relative_to(TEMPLATES).with_suffix("")
        text = template.read_text(encoding="utf-8")
        texts[(DOCS.parent if page.name == "README.md" else DOCS) / page] = FIGURE.sub(
            lambda at: written(named[at[1]], results, at[2] or ""), text
        )
    return texts


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
