"""Logs of schema 3.x, which version 0.3 wrote, and snapshots without side and risk, in every reader."""

import gzip
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scripted_states import scripted_states, write_states

from worldstate import WorldState
from worldstate.adapters.export.log_messages import image_message, mcap_file, read_messages, sound_message
from worldstate.adapters.export.scene import scene_update
from worldstate.adapters.ros.bag_writer import risk_advisories
from worldstate.adapters.state_log import read_log
from worldstate.cli.main import main
from worldstate.state import RiskCue

FORMER = Path(__file__).parent / "schema_3"
EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
# Reasons against the use of the cues, for each snapshot of the logs that version 0.3 wrote.
EXPECTED = {
    "watched": [
        ("too little sound",), (), (), ("budget broken",), ("budget broken",), ("budget broken", "masked"),
        ("unheard", "expired"), ("budget broken",),
    ],
    "announced": [(), ("unknown sound",), (), (), ("unheard",)],
    "uncalibrated": [("uncalibrated",), ("uncalibrated", "masked")],
}  # fmt: skip


def former_log(name: str, folder: Path) -> Path:
    """Unpack a log of schema 3.0.0: JSON lines, or a bag."""
    packed = FORMER / f"{name}.jsonl.gz"
    if packed.is_file():
        path = folder / f"{name}.jsonl"
        path.write_bytes(gzip.decompress(packed.read_bytes()))
        return path
    bag = folder / name
    shutil.copytree(FORMER / name, bag)
    for part in bag.glob("*.gz"):
        part.with_suffix("").write_bytes(gzip.decompress(part.read_bytes()))
        part.unlink()
    return bag


def former_mcap(name: str, folder: Path) -> Path:
    """Write a former log's lines as MCAP, with an empty scene, an image and sound beside each."""
    path, form = folder / f"{name}.mcap", {"schema_name": "any", "schema": b"{}"}
    with mcap_file(path) as write:
        for line in former_log(name, folder).read_bytes().splitlines():
            stamp_ns = json.loads(line)["stamp_ns"]
            for topic, data in {"snapshot": line, "scene": b'{"deletions": [], "entities": []}'}.items():
                write(SimpleNamespace(topic=f"/worldstate/{topic}", stamp_ns=stamp_ns, data=data, **form))
            write(image_message(stamp_ns, b"a jpeg"))
            write(sound_message(stamp_ns, np.zeros(80, np.float32), 8000))
    return path


@pytest.mark.parametrize("name", EXPECTED)
def test_a_former_log_is_read_as_its_upgrade_and_loses_nothing(name, tmp_path):
    log, upgraded = former_log(name, tmp_path), tmp_path / "upgraded.jsonl"
    assert main(["log", "upgrade", str(log), str(upgraded)]) == 0
    assert list(read_log(log)) == list(read_log(upgraded))
    assert [{cue.why_not for cue in state.cues} for _, state in read_log(upgraded)] == [
        {reasons} for reasons in EXPECTED[name]
    ]
    again = tmp_path / "again.jsonl"
    assert main(["log", "upgrade", str(upgraded), str(again)]) == 0
    assert again.read_bytes() == upgraded.read_bytes()
    if log.suffix == ".jsonl":
        for before, after in zip(*(map(json.loads, path.open()) for path in (log, upgraded)), strict=True):
            assert after.pop("schema")["version"] == "4.2.0" and before.pop("schema")
            for cue in after["cues"]:
                assert cue.pop("usable") == (not cue.pop("why_not"))
            if budget := before["budget"]:
                assert budget.pop("threshold_shift_nats") == budget["tally"].pop("lost") == 0
            # Added since.
            assert after["context"].pop("hidden_by_side") is None and after.pop("no_model") is None
            assert not (after["bearing"] or {"at_edge": False}).pop("at_edge")
            assert all(one.pop("kinds") is None for one in after["heard"] or ())
            if budget := after["budget"]:
                assert budget.pop("asked_alpha") is budget.pop("promise") is None
            assert after == before


def test_a_former_mcap_file_keeps_its_images_and_sound_and_is_drawn_anew(tmp_path):
    log, upgraded = former_mcap("watched", tmp_path), tmp_path / "upgraded.mcap"
    assert main(["log", "upgrade", str(log), str(upgraded)]) == 0
    assert list(read_log(log)) == list(read_log(upgraded))
    for topic in ("/camera/image", "/microphones/sound"):
        first, second = (
            [(stamp_ns, json.loads(text)) for stamp_ns, _, text in read_messages(path, topic)]
            for path in (log, upgraded)
        )
        assert len(first) == 8 and first == second
    scenes = [text for _, _, text in read_messages(upgraded, "/worldstate/scene")]
    assert "not usable: budget broken" in scenes[3] and "not usable" not in scenes[1]


@pytest.mark.parametrize(("given", "named"), [("watched.mcap", "x.jsonl"), ("watched.jsonl", "x.mcap")])
def test_an_upgrade_to_another_form_is_refused(given, named, tmp_path, capsys):
    former_mcap("watched", tmp_path)
    assert main(["log", "upgrade", str(tmp_path / given), str(tmp_path / named)]) == 2
    assert named in capsys.readouterr().err and not (tmp_path / named).exists()


def without_model(state: WorldState) -> WorldState:
    """Return the snapshot of an array without a model: directions of sound without side, class or risk."""
    cues = (RiskCue(None, 0.4, 0.2, None, None, None, None, None),)
    unknown = dict.fromkeys(("status", "hidden_probability", "classification", "direction", "sector_rad"))
    heard = tuple(replace(one, sides=(), **unknown) for one in state.entities)
    return replace(state, cues=cues, entities=heard, relations=(), calibrated=False)


def test_unknown_sides_classes_and_risks_are_left_out_and_not_zero(tmp_path, capsys):
    states = [without_model(one) for one in scripted_states()]
    log = write_states(tmp_path / "states.jsonl", states)
    assert [state for _, state in read_log(log)] == states and {one.risk for one in states} == {None}
    (cue,) = risk_advisories(states[0])["advisories"]
    assert cue["direction"] == "" and not cue["usable"]
    assert all(math.isnan(cue[key]) for key in ("risk", "confidence", "hidden", "visible", "none"))
    items = {item.id: item for item in scene_update(states[0]).entities}
    assert items["cue side unknown"].triangles == () and "risk" not in str(items["cue side unknown"])
    assert main(["explain", str(log)]) == 0
    explained = capsys.readouterr().out
    assert "side unknown: advisory none" in explained and "risk" not in explained.partition("time")[2]
    outputs = "mcap=a.mcap", "autoware=a.jsonl", "mot=a.txt", "osi=a.osi", "rosbag=a.bag"
    exports = [word for one in outputs for word in ("--export", one.replace("=", f"={tmp_path}/"))]
    assert main(["log", "replay", str(log), *exports]) == 0
    assert "peak_risk          -" in capsys.readouterr().out
    page, figure, above = (tmp_path / one for one in ("page.html", "over_time.png", "above.png"))
    assert main(["log", "view", str(log), "--out", str(page)]) == 0
    assert '"cues":[]' in page.read_text() and '"risk"' not in page.read_text().partition("<script>")[0]
    assert main(["log", "plot", str(log), "--out", str(figure), "--birds-eye", str(above)]) == 0
