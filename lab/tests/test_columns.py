"""Distances of columns: laws over random excerpts, scipy's energy distance, the command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_corner import write_corner
from scipy.stats import energy_distance
from test_summed_scores import stream
from worldstate_lab.cli.main import main
from worldstate_lab.streets.column_distances import (
    COMPARED,
    LENGTH_S,
    T0_S,
    Excerpt,
    column_distances,
    stream_excerpts,
)

from worldstate.abduction.sequence.sequence_inputs import BANDS, COLUMNS

TIME_S = 1.0 + 0.1 * np.arange(91)
LEVELS = [COLUMNS.index(name) for name in ("level", "loudness", *(f"band_{i + 1}" for i in range(BANDS)))]


def columns(seed, hops=91):
    return np.random.default_rng(seed).normal(size=(hops, len(COLUMNS)))


def junction(name, offset, rng, number=40):
    """Return excerpts whose columns are normal noise around an offset, alternately approaches and quiet
    ones."""
    found = []
    for i in range(number):
        rows = offset + rng.normal(size=(1, len(COMPARED)))
        kind = "0.5 s before T0" if i % 2 else "no hazard"
        found.append(Excerpt(name, bool(i % 2), {kind: rows}))
    return found


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(-10.0, 10.0), st.sampled_from(["left", "right", "none"]))
def test_neither_a_mirrored_street_nor_a_gain_changes_a_statistic(seed, nats, side):
    rows, swapped = columns(seed), COLUMNS.index("bearing")
    louder, mirrored = rows.copy(), rows.copy()
    louder[:, LEVELS] += nats
    mirrored[:, :2], mirrored[:, swapped] = rows[:, [1, 0]], -rows[:, swapped]
    others = [(side, louder)]
    others += [({"left": "right", "right": "left"}[side], mirrored)] if side != "none" else []
    one = Excerpt.of("J", side, T0_S, TIME_S, rows).statistics
    for label, some in others:
        two = Excerpt.of("J", label, T0_S, TIME_S, some).statistics
        assert one.keys() == two.keys()
        for name, values in one.items():
            np.testing.assert_allclose(values, two[name], atol=1e-9)


def test_statistics_are_those_of_their_hops():
    """A ramp in every column: its value at T0 - t, its change, and none in rejected hops."""
    rows = np.tile(TIME_S[:, None], len(COLUMNS))
    rows[(TIME_S > 4.95) & (TIME_S < 5.05)] = np.nan
    found = Excerpt.of("J", "left", T0_S, TIME_S, rows).statistics
    this = COMPARED.index("this")
    for before_s in (0.5, 1.0, 3.0, 4.0, 5.0):
        assert found[f"{before_s:g} s before T0"][0, this] == pytest.approx(T0_S - before_s)
    assert len(found["2 s before T0"]) == 0
    for change_s in (1.0, 2.0, 3.0):
        assert found[f"change in {change_s:g} s, before T0"][0, this] == pytest.approx(change_s)


def test_the_squared_distance_is_half_of_scipys_and_zero_for_two_draws_of_one_street():
    rng = np.random.default_rng(0)
    same = [column_distances(*two_sets(rng, 0.0), rng, draws=40) for _ in range(4)]
    assert max(abs(np.mean([getattr(one, name) for one in same])) for name in ("real", "halves")) < 0.02
    real, simulated = two_sets(rng, 3.0)
    found = column_distances(real, simulated, rng, draws=40)
    expected = []
    for hazard, kind in ((True, "0.5 s before T0"), (False, "no hazard")):
        values, others = (
            np.concatenate([one.statistics[kind] for one in some if one.hazard == hazard])
            for some in (real, simulated)
        )
        width = np.ptp(np.quantile(values, (0.25, 0.75), axis=0), axis=0)
        pairs = zip((values / width).T, (others / width).T, strict=True)
        expected += [0.5 * energy_distance(*two) ** 2 for two in pairs]
    assert found.simulated.mean() == pytest.approx(np.mean(expected), rel=0.1)
    assert min(one.value for one in (*found.ratios, found.mean)) > 3.0 and found.median.low > 3.0


def two_sets(rng, offset):
    """Return two real junctions of one street, and a simulated one at a distance."""
    real = [*junction("SA1", 0.0, rng), *junction("SB1", 0.0, rng)]
    return real, junction("SA1", offset, rng)


def test_a_stream_is_cut_at_approaches_of_a_single_vehicle():
    vehicles = (("left", 20.0), ("right", 35.0), ("left", 39.0), ("right", 60.0))
    heard = stream(vehicles, 0)
    found = stream_excerpts(heard, columns(0, len(heard.hops)))
    # The vehicle that follows after four seconds is left out
    assert [one.hazard for one in found] == [True, True, True]
    assert len(stream_excerpts(heard, columns(0, len(heard.hops)))[0].statistics["5 s before T0"]) == 1
    quiet = stream((), 1)
    assert len(stream_excerpts(quiet, columns(1, len(quiet.hops)))) == int(quiet.hops.time_s[-1] / LENGTH_S)
    in_view = replace(heard, rows=heard.rows.replace(in_view=np.ones(len(heard.rows), bool)))
    assert not stream_excerpts(in_view, columns(0, len(heard.hops)))


def test_the_command_compares_streams_with_recordings(tmp_path, capsys):
    folder = write_corner(tmp_path / "corner", np.random.default_rng(0), 4, 4)
    paths = []
    passing = (("left", 20.0), ("right", 35.0), ("left", 50.0))
    for i, (site, vehicles) in enumerate((("SA101", passing), ("SA101", ()), ("TA101", passing))):
        one = stream(vehicles, int(not vehicles))
        one = replace(one, hops=one.hops.replace(about={**one.hops.about, "site": site}))
        paths.append(tmp_path / f"{site}-{i}.npz")
        one.save(paths[-1])
    words = ["columns", str(folder), "--path", "seven_on_time", "--streams", *map(str, paths)]
    assert main([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["excerpts"] == {"real": [4, 8], "S": [3, 10], "T": [3, 3]}
    assert [row[0] for row in report["distances"]["rows"]] == [*COMPARED, "mean", "median"]
    assert main([*words, "--statistics"]) == 0
    printed = capsys.readouterr().out
    assert "ratio, T" in printed and "0.5 s before T0" in printed
