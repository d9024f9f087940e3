"""The folder of the released real feature windows; tests without it are skipped."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TABLE = "extracted_features.csv"


def released_folder() -> Path | None:
    """Return the path of OVAD_FEATURES, or the folder beside the repository."""
    for place in filter(None, (os.environ.get("OVAD_FEATURES"), ROOT.parent / "shared" / "ovad")):
        folder = Path(place)
        folder = folder if folder.is_dir() else folder.parent
        if (folder / TABLE).is_file():
            return folder
    return None


FOLDER = released_folder()
needs_released_windows = pytest.mark.skipif(
    FOLDER is None, reason=f"{TABLE} neither where OVAD_FEATURES points nor in ../shared/ovad"
)
