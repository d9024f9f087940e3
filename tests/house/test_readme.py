"""The README's first program runs as printed."""

import re
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def first_program() -> str:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.search(r"```python\n(.*?)```", text, flags=re.DOTALL).group(1)


def test_the_eight_lines_are_eight():
    assert len([line for line in first_program().splitlines() if line.strip()]) == 8


@pytest.mark.xdist_group("approach")
def test_the_eight_lines_run(approach, tmp_path, monkeypatch, capsys):
    shutil.copy(approach.audio_path, tmp_path / "some.wav")
    shutil.copy(approach.array_path, tmp_path / "mics.xml")
    shutil.copy(approach.detections_path, tmp_path / "d.json")
    monkeypatch.chdir(tmp_path)
    exec(compile(first_program(), "README.md", "exec"), {})
    assert "hidden" in capsys.readouterr().out
