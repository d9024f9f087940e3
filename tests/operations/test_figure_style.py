"""Figure files: format by name, whole files and unchanged settings of the caller."""

from itertools import combinations

import matplotlib as mpl
import numpy as np
import pytest

from worldstate.ground.errors import InputFileError
from worldstate.operations.figure_style import (
    CATEGORIES,
    DECISION,
    HEARD,
    HIDDEN,
    IN_VIEW,
    SEARCHED,
    TRUTH,
    figure_file,
    legend_beside,
)

MEANINGS = HIDDEN, IN_VIEW, SEARCHED, HEARD, TRUTH, DECISION


@pytest.mark.parametrize("name", ["a.xyz", "a", "a.jpg"])
def test_an_unknown_figure_format_raises_an_error_before_drawing(name, tmp_path):
    with pytest.raises(InputFileError, match=r"\.png, \.svg, \.pdf"), figure_file(tmp_path / name, 3, 2):
        pytest.fail("drawn")
    assert not list(tmp_path.iterdir())


def test_figures_are_reproducible_and_keep_the_style_of_the_caller(tmp_path):
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


# Linear sRGB as seen with protanopia, deuteranopia and tritanopia (Machado et al. 2009), and CIE XYZ.
SEEN = np.array([
    np.eye(3),
    [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
])  # fmt: skip
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def linear(colour):
    shown = np.array(mpl.colors.to_rgb(colour))
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)


def lab(seen):
    share = XYZ @ np.clip(seen, 0.0, 1.0) / XYZ.sum(axis=1)
    x, y, z = np.where(share > 0.008856, np.cbrt(share), 7.787 * share + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("colours", [MEANINGS, CATEGORIES])
def test_colours_differ_with_any_colour_vision(colours):
    for one, other in combinations(colours, 2):
        apart = [np.linalg.norm(lab(seen @ linear(one)) - lab(seen @ linear(other))) for seen in SEEN]
        assert min(apart) > 15.0, (one, other)


@pytest.mark.parametrize("colour", MEANINGS)
def test_colours_have_contrast_on_white(colour):
    assert 1.05 / (XYZ[1] @ linear(colour) + 0.05) > 3.0
