"""What every tutorial takes: `--out FOLDER` and `--size small|full`."""

import argparse
from pathlib import Path


def tutorial_options(doc: str | None) -> tuple[Path, str]:
    """Read the options of a tutorial, make its folder, and return folder and size."""
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--out", type=Path, default=Path("out/tutorials"), help="(default: %(default)s)")
    parser.add_argument("--size", choices=("small", "full"), default="full", help="small: for tests")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    return given.out, given.size
