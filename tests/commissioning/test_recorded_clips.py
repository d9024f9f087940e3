"""Clips of users: learning, weights and errors."""

from pathlib import Path

import numpy as np
import pytest
import soundfile

from worldstate.abduction.road_users import DomainGuard, Foreign
from worldstate.commissioning.guard_training import CLOSE, SoundRows, fit_guard, of_guard, rows_of_clip
from worldstate.commissioning.recorded_clips import HOPS_EACH, heard_clip, read_recorded
from worldstate.commissioning.road_user_training import RoadUserRows, with_close
from worldstate.frontend.spectra.sound_character import MEASURES
from worldstate.ground.errors import InputFileError

RATE = 16_000


HEADER = "file", "kind", "recording", "road_user"


def table(folder: Path, rows: list[tuple[str, ...]], header: tuple[str, ...] = HEADER) -> Path:
    (folder / "clips.csv").write_text("\n".join(map(",".join, (header, *rows, ()))))
    return folder / "clips.csv"


def hops_of(rows: SoundRows) -> dict[str, int]:
    return dict(zip(*(one.tolist() for one in np.unique(rows.kinds, return_counts=True)), strict=True))


def pump(path: Path, seed: int) -> str:
    """Write a machine that the simulator lacks: noise of twenty strokes per second."""
    rng, time = np.random.default_rng(seed), np.arange(4 * RATE) / RATE
    noise = np.convolve(rng.standard_normal(len(time)), np.ones(int(rng.integers(3, 9))), "same")
    strokes = 1.0 + 0.7 * np.sin(2.0 * np.pi * rng.uniform(18.0, 22.0) * time)
    soundfile.write(path, 0.02 * strokes * noise, RATE)
    return path.name


def simulated() -> SoundRows:
    """Render close clips of streets, foreign sounds and signals."""
    names = [*("light", "idling light", "heavy", "voice", "dog", "music", "siren", "horns")] * 3
    draws = zip(names, range(len(names)), np.random.default_rng(5).spawn(len(names)), strict=True)
    return SoundRows.joined([rows_of_clip(6000.0, one) for one in draws])


def foreign_share(guard: DomainGuard, measures: np.ndarray) -> float:
    return float(np.mean([isinstance(guard.judge(one), Foreign) for one in measures[:, : len(MEASURES)]]))


@pytest.mark.long
def test_a_learned_foreign_sound_is_detected_more_often(tmp_path: Path) -> None:
    rows = [(pump(tmp_path / f"{n}.wav", n), "pump", f"r{n}", "") for n in range(8)]
    learned = read_recorded(tmp_path, table(tmp_path, rows))
    others = (tmp_path / pump(tmp_path / f"{n}.wav", n) for n in (101, 102, 103))
    held_out = np.concatenate(list(map(heard_clip, others)))
    base = simulated()
    before = fit_guard(of_guard(base))
    after = fit_guard(of_guard(SoundRows.joined([base, learned.rows])))
    assert "pump" in after.foreign and "pump" not in before.foreign
    assert foreign_share(after, held_out) > foreign_share(before, held_out) + 0.2
    # Vehicles still count as street.
    street = base.select(np.isin(base.kinds, ["light", "heavy"])).measures
    assert foreign_share(after, street) < foreign_share(before, street) + 0.05


def test_recordings_have_equal_weight(tmp_path: Path) -> None:
    kinds = [
        *(("tram", "r0", ""), ("anything", "r1", "car"), ("anything", "r1", "car"), ("speech", "r2", "")),
        *(("reversing beeper", "r3", ""), ("street", "r4", ""), ("pump", "r5", ""), ("siren", "r1", "")),
    ]
    path = table(tmp_path, [(pump(tmp_path / f"{n}.wav", n), *rest) for n, rest in enumerate(kinds)])
    learned = read_recorded(tmp_path, path)
    simulated_kinds = ["beeper", CLOSE, "light", "pump", "siren", "tram", "voice"]
    assert hops_of(learned.rows) == dict.fromkeys(simulated_kinds, HOPS_EACH)
    names = ["tram", "car", "speech", "reversing beeper", "street", "pump", "siren"]
    assert learned.recordings == dict.fromkeys(names, 1)
    assert "car 1, speech 1" in learned.told and learned.digest in learned.told
    assert "not the project's own" in learned.told
    path.write_text(path.read_text() + "\n")
    assert read_recorded(tmp_path, path).digest != learned.digest
    nothing, no_hops = np.zeros(len(learned.rows.kinds), bool), np.zeros(0, bool)
    none = learned.rows.select(nothing)
    vehicles = with_close(RoadUserRows(none.measures, none.kinds, none.sites, no_hops, no_hops), learned.rows)
    assert set(vehicles.kinds.tolist()) == {"light", "tram"}
    assert set(of_guard(learned.rows).kinds.tolist()) == {CLOSE, "pump", "siren", "beeper", "voice"}


def test_buses_of_free_recordings_count_as_trucks(tmp_path: Path) -> None:
    free, header = "Creative Commons 0", ("file", "kind", "licence")
    rows = [(pump(tmp_path / f"{n}.wav", n), kind, free) for n, kind in enumerate(("bus", "bus", "tram"))]
    learned = read_recorded(tmp_path, table(tmp_path, rows, header))
    assert hops_of(learned.rows) == {"heavy": 2 * HOPS_EACH, "tram": HOPS_EACH}
    assert set(of_guard(learned.rows).kinds.tolist()) == {CLOSE}
    assert learned.licences == (free,)
    assert f"3 recordings beside the simulation (bus 2, tram 1; {free}" in learned.told
    # A model of CC0 recordings belongs to the project; one recording without a licence changes that.
    assert "not the project's own" not in learned.told
    rows.append((pump(tmp_path / "3.wav", 3), "bus", ""))
    told = read_recorded(tmp_path, table(tmp_path, rows, header)).told
    assert "licence not stated" in told and "not the project's own" in told


@pytest.mark.parametrize(
    ("row", "told"),
    [
        (("a.wav", "pump", "r", "ufo"), "line 2: road_user: expected one of"),
        (("a.wav", "", "r", ""), "line 2: kind"),
        (("b.wav", "pump", "r", ""), "b.wav"),
        (None, "at least one clip"),
    ],
)
def test_wrong_tables_of_clips_raise_an_error(tmp_path: Path, row: tuple[str, ...] | None, told: str) -> None:
    pump(tmp_path / "a.wav", 1)
    with pytest.raises(InputFileError, match=told):
        read_recorded(tmp_path, table(tmp_path, [] if row is None else [row]))
