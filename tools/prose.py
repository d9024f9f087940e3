"""Count turns of phrase that an editor would strike, per 1,000 words of each kind of prose.

    python tools/prose.py               # a table by kind; fails if a kind is above its limit
    python tools/prose.py docs/guide    # each place below a file or folder, with its line

Prose is Markdown without code blocks, and the docstrings and comments of Python files.
"""

import io
import re
import subprocess
import sys
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Turns per 1,000 words; reviewed libraries of the field have 0.6 to 1.7. Kinds below this size have no limit.
LIMIT, FEWEST_WORDS = 5.0, 500
# Kinds that were above it when the limit was set: theirs only falls.
HIGHER = {"tests (code)": 12.0}
TURNS = {
    "where for if": r"\bwhere (?:it|they|there|none|one|no|an?|the|that|not|nothing|this|its|both)\b",
    "what for a noun": r"(?:^|[\s(*|])what "
    r"(?:is|was|has|it|they|an?|the|of|one|each|comes?|came|stands|makes|holds)\b",
    "a thing that speaks": r"\b(?:says|said|tells|told|asks|asked|knows|speaks|answers)\b"
    r"|(?<!the )(?<!of )\bnames\b",
    "a thing that hears": r"\b(?:hears|heard|ears?|listens)\b",
    "stands, lies, goes": r"\b(?:stands?|stood|lies?|goes on|go on|went on)\b",
    "counts, weighs, moves": r"\b(?:counts|counted|weighs|moves)\b",
    "an hour for per hour": r"\b(?:an (?:hour|entity)|"
    r"a (?:hop|side|second|minute|snapshot|microphone|line|vehicle)) ?"
    r"(?=[,.;:)]|\b(?:at|for|in|of|is|are|and)\b)",
    "no leading zero": r"(?<![\w.])\.\d",
}
_TURN = re.compile(
    "|".join(f"(?P<t{at}>{turn})" for at, turn in enumerate(TURNS.values())), re.IGNORECASE | re.MULTILINE
)
_HIDDEN = re.compile(r"```.*?```|<!--.*?-->|`[^`\n]*`", re.DOTALL)


def prose(path: Path) -> str:
    """Return the prose of a file, each word on its own line of the file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return _HIDDEN.sub(lambda hidden: re.sub(r"[^\n]", " ", hidden[0]), text)
    lines = [""] * (text.count("\n") + 2)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            lines[token.start[0]] += token.string.lstrip("#:! ")
        elif token.type == tokenize.STRING and token.string.startswith(('"""', 'r"""')):
            for at, line in enumerate(token.string.splitlines()):
                lines[token.start[0] + at] += line.strip().replace('"""', "")
    return "\n".join(lines[1:])


def kind(path: Path) -> str:
    """Return the kind of prose that a file holds: a folder of pages, a page, or a room of the code."""
    top, *rest = path.parts
    if path.suffix == ".md":
        return f"{top}/{rest[0]}" if len(rest) > 1 else str(path)
    return f"{top}/{rest[0]}" if top == "worldstate" and len(rest) > 1 else f"{top} (code)"


def files() -> Iterator[Path]:
    """Yield the files of prose under version control, links and lists of figures left out."""
    listed = subprocess.run(
        ["git", "-C", ROOT, "ls-files", "*.md", "*.py"], capture_output=True, text=True, check=True
    )
    for name in listed.stdout.splitlines():
        if not (ROOT / name).is_symlink() and not name.endswith("evidence/results.md"):
            yield Path(name)


def main(below: list[str]) -> int:
    """Print the places below files or folders, then the table; return 1 if a kind is above its limit."""
    words, turns = Counter[str](), defaultdict[str, Counter[str]](Counter)
    for path in files():
        if below and not any(path.is_relative_to(folder) for folder in below):
            continue
        text = prose(ROOT / path)
        words[kind(path)] += len(text.split())
        for found in _TURN.finditer(text):
            turn = list(TURNS)[int((found.lastgroup or "t0")[1:])]
            turns[kind(path)][turn] += 1
            if below:
                line = text.count("\n", 0, found.start(found.lastgroup or 0) + 1) + 1
                print(f"{path}:{line}: {turn}: {' '.join(found[0].split())}")
    above = False
    for room in sorted(words):
        rate = 1000 * turns[room].total() / max(words[room], 1)
        limit = HIGHER.get(room, LIMIT)
        is_above = words[room] >= FEWEST_WORDS and rate > limit
        above |= is_above
        print(
            f"{room:32}{words[room]:8} words{rate:7.1f} per 1,000{f', above {limit:g}' if is_above else ''}"
        )
    return int(above)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
