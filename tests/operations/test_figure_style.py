"""Figures are written whole, in a format that the name says, and leave the caller's settings alone."""

import matplotlib as mpl
import pytest

from worldstate.ground.errors import InputFileError
from worldstate.operations.figure_style import figure_file, legend_beside


@pytest.mark.parametrize("name", ["a.xyz", "a", "a.jpg"])
def test_a_suffix_that_cannot_be_drawn_is_refused_before_anything_is(name, tmp_path):
    with pytest.raises(InputFileError, match=r"\.png, \.svg, \.pdf"), figure_file(tmp_path / name, 3, 2):
        pytest.fail("drawn")
    assert not list(tmp_path.iterdir())


def test_the_same_figure_gives_the_same_file_and_style_stays_within(tmp_path):
    before = dict(mpl.rcParams)
    for name in ("a.svg", "b.svg"):
        with figure_file(tmp_path / name, 3, 2) as figure:
            axes = figure.subplots()
            axes.plot([1, 2], label="twice")
            axes.plot([2, 1], label="twice")
            legend_beside(axes)
            assert [text.get_text() for text in axes.get_legend().get_texts()] == ["twice"]
    first, second = ((tmp_path / name).read_text() for name in ("a.svg", "b.svg"))
    strip = [[line for line in text.splitlines() if "dc:date" not in line] for text in (first, second)]
    assert strip[0] == strip[1]
    assert dict(mpl.rcParams) == before


def test_a_figure_that_fails_leaves_no_file(tmp_path):
    with pytest.raises(ZeroDivisionError), figure_file(tmp_path / "a.png", 3, 2):
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())
