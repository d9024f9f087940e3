"""Shadow hours: counts, exact intervals and the further hours that prove a budget."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from worldstate.operations.corpus.corpus_tables import StateHours
from worldstate.operations.corpus.shadow import hours_to_prove, shadow_hours, write_shadow_page

HOURS = st.builds(
    StateHours,
    recording=st.just("a.wav"),
    site=st.sampled_from(["", "elm street", "oak street"]),
    day=st.sampled_from([None, "2026-11-28", "2026-11-29"]),
    sensors=st.sampled_from(["acoustic working", "acoustic working, camera silent"]),
    unheard=st.sampled_from([None, "wind", "clipped"]),
    hops=st.integers(1, 100_000),
    onsets=st.integers(0, 20),
)


@given(st.lists(HOURS, min_size=1))
def test_all_groupings_have_the_same_hours_and_onsets(rows):
    week = shadow_hours(rows, budget=30.0)
    heard = sum(row.hops for row in rows if row.unheard is None) / 36_000
    for group in week.values():
        assert sum(one.onsets for one in group) == sum(row.onsets for row in rows)
        assert sum(one.heard_hours for one in group) == pytest.approx(heard)
        total = sum(one.heard_hours + one.unheard_hours for one in group)
        assert total == pytest.approx(sum(row.hops for row in rows) / 36_000)
    (everything,) = week["all"]
    if heard:
        n, low = everything.onsets, stats.chi2.ppf(0.025, 2 * everything.onsets)
        assert everything.high == pytest.approx(stats.chi2.ppf(0.975, 2 * n + 2) / 2 / heard)
        assert everything.low == pytest.approx(low / 2 / heard if n else 0.0)


@given(st.integers(0, 50), st.floats(0.1, 1e4), st.floats(0.01, 100.0))
def test_hours_to_prove_a_budget_are_the_fewest(onsets, hours, budget):
    more = hours_to_prove(onsets, hours, budget)
    if onsets >= budget * hours:
        assert more is None
        return
    upper = stats.chi2.ppf(0.975, 2 * onsets / hours * (hours + more) + 2) / 2 / (hours + more)
    assert upper <= budget * (1.0 + 1e-4)
    if more:
        assert upper == pytest.approx(budget, rel=1e-3)


def test_the_shadow_page_escapes_names_and_counts_omitted_rows(tmp_path):
    rows = [StateHours("a", f"<script>{i}", None, "acoustic working", None, 36_000, i) for i in range(50)]
    write_shadow_page(tmp_path / "week.html", shadow_hours(rows, None), "fleet & co")
    page = (tmp_path / "week.html").read_text()
    assert "<script" not in page and "&lt;script&gt;0" in page and "fleet &amp; co" in page
    assert "<caption>10 more</caption>" in page
