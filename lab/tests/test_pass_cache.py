"""Results of passes over recordings: cached by content, and the same on any number of processes."""

import os
from dataclasses import replace

import hypothesis.extra.numpy as npst
import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_trials import gram
from worldstate_lab.trials import pass_cache
from worldstate_lab.trials.classification import windows_origin
from worldstate_lab.trials.pass_cache import Failed, PassCache, attempted, fingerprint

from worldstate.adapters.datasets.feature_extraction import LabelledWindow
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground.errors import InputFileError
from worldstate.operations.recordings.hop_table import HopTable, load_named, save_named

DTYPES = st.sampled_from([np.float64, np.float32, np.int64, np.bool_, "<U7"])
NAMES = st.text("abc_", min_size=1, max_size=4)


@st.composite
def tables(draw):
    n = draw(st.integers(0, 3))
    tails = st.sampled_from([(), (4,), (0,), (2, 3)])
    columns = {
        name: draw(npst.arrays(draw(DTYPES), (n, *draw(tails))))
        for name in draw(st.lists(NAMES, max_size=3, unique=True))
    }
    about = draw(st.dictionaries(NAMES, st.one_of(st.booleans(), st.floats(), st.text()), max_size=2))
    return HopTable(columns, draw(st.text(max_size=3)), draw(NAMES), draw(st.floats()), about)


def assert_same(first, second):
    assert list(first) == list(second)
    for one, other in zip(first.values(), second.values(), strict=True):
        # In text NaN equals NaN, which `==` does not give.
        fields = (repr((some.name, some.label, some.t0_s, some.about)) for some in (one, other))
        assert len({*fields}) == 1
        assert list(one.columns) == list(other.columns)
        for mine, theirs in zip(one.columns.values(), other.columns.values(), strict=True):
            np.testing.assert_array_equal(mine, theirs, strict=True)


@settings(max_examples=40, deadline=None)
@given(named=st.dictionaries(NAMES, tables(), max_size=3))
def test_named_tables_of_any_columns_are_read_back_unchanged(named, tmp_path_factory):
    path = tmp_path_factory.mktemp("named") / "a.npz"
    save_named(path, named)
    assert_same(load_named(path, "tables"), named)


def never():
    raise AssertionError("was to be read, not made")


def some_tables():
    boxes = HopTable({"label": np.array(["car", "bus"]), "box_px": np.ones((2, 4))}, about={"site": "SA1"})
    return {"boxes": boxes, "none": HopTable({"label": np.zeros(0, "<U3")})}


def test_a_pass_is_computed_once_for_each_key(tmp_path):
    cache = PassCache(tmp_path / "cache")
    assert_same(cache.tables("sound", {"a": 1}, some_tables), some_tables())
    assert_same(cache.tables("sound", {"a": 1}, never), some_tables())
    assert cache.tables("sound", {"a": 2}, dict) == {} == cache.tables("sound", {"a": 2}, never)
    with pytest.raises(AssertionError):
        cache.tables("camera", {"a": 1}, never)
    assert not [*(tmp_path / "cache" / "camera").iterdir()]


def recording(folder):
    folder.mkdir()
    for name in ("out_multi.wav", "camera_baseline_results.json", "truth.json"):
        (folder / name).write_text(name)
    return folder


def test_a_fingerprint_depends_only_on_the_content(tmp_path, monkeypatch):
    memo = tmp_path / "memo"
    one, other = recording(tmp_path / "one"), recording(tmp_path / "other")
    same = fingerprint(one, memo)
    with monkeypatch.context() as unread:  # Unchanged files are not read again
        unread.setattr(pass_cache, "content_hash", lambda path: never())
        assert fingerprint(one, memo) == same
    assert fingerprint(other, memo) == same == fingerprint(one, tmp_path / "another")
    (one / "notes.txt").write_text("windy")
    os.utime(one / "out_multi.wav")
    assert fingerprint(one, memo) == same
    seen = {same}
    for name in ("out_multi.wav", "truth.json", "ueye_stereo_vid.mp4"):
        (one / name).write_text(f"{name} changed")
        seen.add(fingerprint(one, memo))
    (one / "truth.json").unlink()
    seen.add(fingerprint(one, memo))
    state = (sound := one / "out_multi.wav").stat()
    sound.write_text("X" * state.st_size)  # Of the same size and time
    os.utime(sound, ns=(state.st_atime_ns, state.st_mtime_ns))
    seen.add(fingerprint(one, memo))
    assert len(seen) == 6


def test_damaged_or_exchanged_tables_are_computed_again_with_a_warning(tmp_path):
    cache = PassCache(tmp_path)
    cache.tables("sound", 1, some_tables)
    [mine] = tmp_path.rglob("*.npz")
    cache.tables("sound", 2, dict)
    [other] = set(tmp_path.rglob("*.npz")) - {mine}
    whole, seal = mine.read_bytes(), mine.with_suffix(".sum").read_bytes()
    theirs, their_seal = other.read_bytes(), other.with_suffix(".sum").read_bytes()
    damaged = [(data, seal) for data in (b"", whole[:100], bytes(len(whole)), theirs)]
    for data, sealed in [*damaged, (theirs, their_seal)]:
        mine.write_bytes(data)
        mine.with_suffix(".sum").write_bytes(sealed)
        with pytest.warns(UserWarning, match="computed again"):
            assert_same(cache.tables("sound", 1, some_tables), some_tables())
        assert_same(cache.tables("sound", 1, never), some_tables())
    mine.with_suffix(".sum").unlink()  # As if a run had been killed between the two files
    with pytest.raises(AssertionError):
        cache.tables("sound", 1, never)


def test_windows_are_identified_by_their_sound_and_not_by_its_path(tmp_path):
    def origin(folder, **changed):
        window = LabelledWindow("1", "left", "SA1", "r", 70, tmp_path / folder / "out_multi.wav", 3.0)
        return windows_origin([replace(window, **changed)], ovad_array(), tmp_path / "memo")

    for folder in ("one", "other"):
        recording(tmp_path / folder)
    assert origin("one") == origin("other")
    seen = {origin("one"), origin("one", label="right"), origin("one", end_s=4.0)}
    (tmp_path / "one" / "out_multi.wav").write_text("changed")
    assert len(seen | {origin("one")}) == 4


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"out_multi.wav": "0"}', "\xff"])
def test_a_damaged_memo_only_causes_another_read(damage, tmp_path):
    memo, place = tmp_path / "memo", recording(tmp_path / "one")
    before = fingerprint(place, memo)
    [path] = memo.iterdir()
    path.write_text(damage, encoding="latin-1")
    assert fingerprint(place, memo) == before


def test_a_sound_file_has_a_fingerprint_and_a_missing_one_has_none(tmp_path):
    memo = tmp_path / "memo"
    (tmp_path / "a.wav").write_text("sound")
    assert len(fingerprint(tmp_path / "a.wav", memo)) == 32
    with pytest.raises(InputFileError, match=r"out_multi\.wav"):
        fingerprint(tmp_path, memo)


@pytest.mark.long
def test_any_number_of_processes_gives_the_same_and_reports_the_broken_recording(tmp_path):
    rng, paths = np.random.default_rng(1), [tmp_path / f"{i}.wav" for i in range(6)]
    for path in paths:
        soundfile.write(path, rng.uniform(-0.5, 0.5, (16_000, 16)), 8000, "PCM_24")
    paths[2].write_bytes(b"no sound")
    paths[4].unlink()
    found = [list(attempted(gram, paths, jobs, name=lambda path: path.stem)) for jobs in (1, 2)]
    for one, other in zip(*found, strict=True):
        assert one == other if isinstance(one, Failed) else one.tobytes() == other.tobytes()
    failed = [one for one in found[0] if isinstance(one, Failed)]
    assert [one.name for one in failed] == ["2", "4"]
    assert f"{paths[2]}: expected a sound file" in failed[0].problem
    assert str(paths[4]) in failed[1].problem


def test_a_programming_error_is_not_a_broken_recording():
    with pytest.raises(TypeError, match="has no len"):
        list(attempted(len, [[0], 1, [2]], jobs=1))
