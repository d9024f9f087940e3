"""The miss-rate table is monotone and exact at its points."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from worldstate.abduction.co_evidence import MissRateTable, default_miss_rates
from worldstate.ground.serialisation import decode, encode


def floats(n, low, high):
    return st.lists(st.floats(low, high), min_size=n, max_size=n)


@st.composite
def tables(draw):
    n_azimuths, n_levels = draw(st.integers(2, 5)), draw(st.integers(2, 5))
    azimuths = np.cumsum(draw(floats(n_azimuths - 1, 1, 20)))
    steps = np.cumsum(draw(floats(n_levels - 1, 0.05, 0.2)))
    rises = np.array(draw(floats(n_azimuths * n_levels, 0, 1)))
    beta = np.cumsum(np.cumsum(rises.reshape(n_azimuths, n_levels), 0), 1)
    beta /= max(1.0, beta[-1, -1])
    rows = tuple(map(tuple, beta.tolist()))
    return MissRateTable((0.0, *azimuths.tolist()), (0.0, *steps.tolist()), rows, {"car": rows})


@given(tables(), st.floats(-1.5, 1.5), st.floats(0, 1))
def test_the_table_is_bilinear_inside_its_range_and_one_outside(table, azimuth_rad, level):
    magnitude = abs(np.degrees(azimuth_rad))
    value = table(azimuth_rad, level)
    if magnitude > table.azimuth_deg[-1] or level > table.degradation[-1]:
        assert value == 1.0
    else:
        oracle = RegularGridInterpolator((table.azimuth_deg, table.degradation), np.array(table.beta))
        assert value == pytest.approx(float(oracle([[magnitude, level]])[0]), abs=1e-9)
    assert table(azimuth_rad, level, "car") == value


@given(tables(), floats(2, 0, 1.5), floats(2, 0, 1))
def test_never_falls_with_azimuth_or_degradation(table, azimuths, levels):
    (near, far), (clean, worse) = sorted(azimuths), sorted(levels)
    assert table(near, clean) <= table(far, clean) + 1e-12
    assert table(near, clean) <= table(near, worse) + 1e-12
    assert table(near, clean) == table(-near, clean)


@given(tables())
def test_reads_back_what_it_wrote(table):
    assert decode(MissRateTable, json.loads(json.dumps(encode(table))), "file") == table


def test_the_default_is_the_measurement_of_the_paper():
    table = default_miss_rates()
    assert table(0.0) == pytest.approx(0.04)
    assert table(np.radians(25)) == pytest.approx(0.14)
    assert table(0.0, 1.0) == pytest.approx(0.97)
    assert table(np.radians(91)) == 1.0


def test_a_class_may_have_rows_of_its_own():
    table = MissRateTable((0, 30), (0, 1), ((0.0, 1.0), (0.2, 1.0)), {"bicycle": ((0.5, 1.0), (0.5, 1.0))})
    assert table(0.0, 0.0, "bicycle") == 0.5
    assert table(0.0, 0.0, "car") == 0.0
