"""Array files of users: all forms give the same positions; ambiguous and damaged files raise an error."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.adapters.files.array_file import named_arrays, read_array, write_array_xml
from worldstate.cli.common.inputs import add_array_options, stance
from worldstate.frontend.array.microphone_array import MicrophoneArray, nearest_spacings_m, roof_array_56
from worldstate.frontend.settings import default_band_hz
from worldstate.ground.errors import InputFileError

PLACES = [[0.5, 0.2, 1.4], [0.5, -0.2, 1.4], [0.1, 0.0, 1.5]]

SAME = {
    "plain.csv": "0.5,0.2,1.4\n0.5,-0.2,1.4\n0.1,0,1.5\n",
    "header.csv": "\ufeffx,y,z\n0.5,0.2,1.4\n0.5,-0.2,1.4\n0.1,0,1.5\n",
    "names.csv": "name,x [m],y [m],z [m]\nleft,0.5,0.2,1.4\nright,0.5,-0.2,1.4\nback,0.1,0,1.5\n",
    "order.csv": "z_m;y_m;x_m\n1.4;0.2;0.5\n1.4;-0.2;0.5\n1.5;0;0.1\n",
    "index.txt": "# my array\n1 0.5 0.2 1.4\n2 0.5 -0.2 1.4\n\n3 0.1 0 1.5\n",
    "behind.tsv": "0.5\t0.2\t1.4\tleft\n0.5\t-0.2\t1.4\tright\n0.1\t0\t1.5\tback\n",
    "list.json": json.dumps(PLACES),
    "object.json": json.dumps({"positions_m": PLACES, "maker": "me"}),
    "acoular.json": json.dumps({"positions_m": [[-y, z, x] for x, y, z in PLACES], "axes": "acoular"}),
    "mics.xml": "<MicArray>"
    + "".join(f'<pos x="{-y}" y="{z}" z="{x}"/>' for x, y, z in PLACES)
    + "</MicArray>",
}
SAME |= {
    "millimetres.csv": "x_mm,y_mm,z_mm\n500,200,1400\n500,-200,1400\n100,0,1500\n",
    "centimetres.csv": "X [cm];Y [cm];Z [cm]\n50;20;140\n50;-20;140\n10;0;150\n",
    "millimetres.json": json.dumps({"positions_mm": [[1000 * one for one in row] for row in PLACES]}),
    "gain.csv": "x,y,z,gain\n0.5,0.2,1.4,0.9\n0.5,-0.2,1.4,1.1\n0.1,0,1.5,0.10\n",
    "behind.csv": "0.5,0.2,1.4,7\n0.5,-0.2,1.4,8\n0.1,0,1.5,9\n",
    "head.csv": "channel,x,y,z\n1,0.5,0.2,1.4\n2,0.5,-0.2,1.4\n3,0.1,0,1.5\n",
}
ODAS = """
version = "2.1"; raw: { path = "http://a /* no comment"; }
/* mics = ( { mu = ( 9, 9, 9 ); } ); */
mapping: { map: (MAP); }
general: {
    samplerate: { mu = 16000; };   # mu: of the rate (Hz)
    mics = (
        # mu: Microphone position coordinates (x, y, z) in meters "with a quote
        { mu = ( +0.5, +0.2, 1.4 ); sigma2 = ( +0.0, +0.0 ); direction = ( 0.0, 0.0, 1.0 );
          angle = ( 80.0, 90.0 ); },
        { mu = ( 5E-1,
                 -0.2, 1.4 ); },  // { mu = ( 1, 2, 3 ); }
        { sigma2 = ( 0.0 ); mu = [ 0.1, 0, 1.5 ]; }
    );
    spatialfilters = ( { direction = ( 0.0, 0.0, 1.0 ); angle = (80.0, 90.0); } );
};
sst: { active = ( { weight = 1.0; mu = 0.3; sigma2 = 0.0025 } ); }
"""
SAME |= {
    "odas.cfg": ODAS.replace("MAP", "1, 2, 3"),
    "matlab.txt": "% my array\n0.5 0.2 1.4\n0.5 -0.2 1.4\n0.1 0 1.5\n",
    "nested.xml": "<a xmlns='urn:mics'>" + SAME["mics.xml"] + "</a>",
    "colons.cfg": ODAS.replace("mics =", "mics:").replace("MAP", "1, 2, 3"),
}


@pytest.mark.parametrize("name", SAME)
def test_every_form_gives_the_same_positions(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(SAME[name])
    np.testing.assert_allclose(read_array(tmp_path / name).positions_m, PLACES, rtol=1e-15)


def test_a_configuration_of_odas_has_channels(tmp_path: Path) -> None:
    (tmp_path / "odas.cfg").write_text(ODAS.replace("MAP", "2, 4, 3"))
    assert read_array(tmp_path / "odas.cfg").channels == (2, 4, 3)


def expect(problem: str, path: Path) -> None:
    with pytest.raises(InputFileError, match=problem) as raised:
        read_array(path)
    assert str(raised.value).startswith(f"{path}: ") and "\n" not in str(raised.value)


POS = '<pos Name="Point {0}" x="0.{0}" y="0" z="0"/>'
TWO = POS.format(1) + POS.format(2)
BOMB = '<!DOCTYPE m [<!ENTITY a "1"><!ENTITY b "&a;&a;">]><MicArray>{}<pos x="&b;" y="0" z="0"/></MicArray>'
EXTERNAL = '<!DOCTYPE m [<!ENTITY a SYSTEM "file:///etc/hostname">]><MicArray>&a;{}</MicArray>'


REFUSED: list[tuple[str | bytes, str]] = [
    ("0.05,0,0,1.0\n0,0.05,0,0.9\n-0.05,0,0,1.1\n0,-0.05,0,0.95\n", "4 numbers per line"),
    ("0.05 0 -0.05 0\n0 0.05 0 -0.05\n0 0 0 0\n", "write its transpose"),
    (json.dumps([[0.1, 0, -0.1, 0], [0, 0.1, 0, -0.1], [0] * 4]), "write its transpose"),
    ("50,0,0\n0,50,0\n-50,0,0\n", r"millimetres\? Then a header x_mm"),
    ("5,0,0\n0,5,0\n-5,0,0\n", r"centimetres\? Then a header x_mm"),
    ("x_mm,y_mm,z\n1,2,3\n2,3,4\n", "one unit of x, y and z, got m, mm"),
    (json.dumps({"positions_m": PLACES, "positions_mm": PLACES}), "its unit in its name"),
    ("x_in,y_in,z_in\n2,0,0\n0,2,0\n", "columns x, y, z"),
    ("mics = [0.05 0 0; 0 0.05 0];\n", "writematrix"),
    (b"MATLAB 5.0 MAT-file\0\0", "writematrix"),
    ('@include "mics.cfg"\ngeneral: { };', "replace @include by the content"),
    ("x;y;z\n0,05;0,00;0,00\n0,00;0,05;0,00\n", "expected decimal points, got decimal commas"),
    ("1 0,05 0 -0,1\n2 0 0,05 0\n", "decimal commas"),
    (b"\x93NUMPY\x01\x00v\x00", "numpy.savetxt"),
    ("mics = ( { mu = ( 0, 0, 0 ); }, { mu = ( 0, 0, 1 ); }", "as in ODAS"),
    ("mics = ( { mu = ( 0, 1, exit ); }, { mu = ( 0, 0, 1 ); } );", "got ' exit '"),
    (ODAS.replace("MAP", "1, 2, " + "9" * 5000), "channels"),
    (ODAS.replace("MAP", "1, 2, 3, 4"), "channels: expected 3 different"),
    *(
        (json.dumps({"positions_m": PLACES, "channels": one}), "channels: expected 3 different")
        for one in ([2, 2, 3], [0, 1, 2], [1, 2, 3.0], "2-4")
    ),
    (BOMB.format(TWO), "entities, which are refused"),
    (EXTERNAL.format(TWO), "entities, which are refused"),
    ("", "as XML, JSON or CSV"),
    ("0,0.1,0\n0,0.2\n", "microphone 2: .* finite number as z, got None"),
    ("0,0,0\n0,0,0.5\n", "vertical line"),
    ("0,1e-5,0\n0,0,0\n", "expected positions in metres"),
    ("0,0.1,0\n0,0.2,0\n0,0.200000001,0\n", "microphones 2 and 3 1e-09 m apart"),
    ("[[0, 0.1, 0], [0, -0.1, true]]", "microphone 2: .* finite number as z, got True"),
    ('{"positions_m": [[0, 0.1, 0], [0, 1, 0]], "axes": "ned"}', "axes: expected acoular or base_link"),
    ('{"positions": []}', "positions_m"),
    ("[" * 100_000, "does not parse"),
    ("<MicArray>" + TWO, "does not parse"),
    (f"<MicArray>{TWO}<pos x='1' y='0'/></MicArray>", "microphone 3: .* finite number as z, got None"),
    ("<MicArray>" + TWO * 513 + "</MicArray>", "got 1026"),
    ("<?xml version='1.0' encoding='klingon'?><MicArray/>", "does not parse"),
]


@pytest.mark.parametrize(("text", "problem"), REFUSED)
def test_ambiguous_and_damaged_arrays_are_refused(text: str | bytes, problem: str, tmp_path: Path) -> None:
    (tmp_path / "mics").write_bytes(text if isinstance(text, bytes) else text.encode())
    expect(problem, tmp_path / "mics")


def test_missing_and_huge_arrays_are_refused(tmp_path: Path) -> None:
    expect("No such file", tmp_path / "no.xml")
    expect("array file", tmp_path)
    (tmp_path / "big.xml").write_bytes(b"<MicArray>" + b" " * (1 << 20) + b"</MicArray>")
    expect("at most", tmp_path / "big.xml")


@given(data=st.binary(max_size=300))
@settings(max_examples=60, deadline=None)
def test_random_bytes_are_no_array(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    name = tmp_path_factory.mktemp("xml") / "mics.xml"
    name.write_bytes(data)
    with pytest.raises(InputFileError):
        read_array(name)


RING = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
TRANSPOSED = [[0.1, 0.0, -0.1], [0.0, 0.1, 0.0], [1.4] * 3]


@pytest.mark.parametrize(
    ("rows", "scale", "said"),
    [
        *((RING, 0.05, ""), (RING, 0.6, ""), (RING, 1.5, "centimetres or inches")),
        *((PLACES, 1.0, ""), (TRANSPOSED, 1.0, "write its transpose")),
    ],
)
def test_doubtful_positions_log_a_warning(rows, scale, said, tmp_path, caplog) -> None:
    (tmp_path / "mics.json").write_text(json.dumps((scale * np.array(rows)).tolist()))
    assert read_array(tmp_path / "mics.json").n_microphones == len(rows)
    assert said in caplog.text and bool(said) == bool(caplog.text)


@pytest.mark.parametrize("form", ["csv", "header", "xml"])
def test_microphones_sorted_as_text_are_ordered_by_number(form, tmp_path, caplog) -> None:
    places = [[0.1 * number, 0.0, 1.0] for number in range(1, 13)]
    for order, said in ((sorted(range(1, 13), key=str), True), (range(1, 13), False)):
        rows = [(f"mic_{number}", *places[number - 1]) for number in order]
        lines = "".join(f"{name},{x},{y},{z}\n" for name, x, y, z in rows)
        marks = "".join(f'<pos Name="{name}" x="{-y}" y="{z}" z="{x}"/>' for name, x, y, z in rows)
        text = {"csv": lines, "header": "name,x,y,z\n" + lines, "xml": f"<MicArray>{marks}</MicArray>"}[form]
        (tmp_path / "mics").write_text(text)
        caplog.clear()
        np.testing.assert_allclose(read_array(tmp_path / "mics").positions_m, places)
        assert ("not in the order of their numbers" in caplog.text) is said


def test_axes_may_be_those_of_the_other_convention(tmp_path: Path) -> None:
    write_array_xml(tmp_path / "mics.xml", MicrophoneArray(PLACES))
    (tmp_path / "mics.csv").write_text("-0.2,1.4,0.5\n0.2,1.4,0.5\n0,1.5,0.1")
    np.testing.assert_array_equal(read_array(tmp_path / "mics.csv", "acoular").positions_m, PLACES)
    turned = read_array(tmp_path / "mics.xml", "base_link").positions_m
    np.testing.assert_array_equal(turned[0], [-0.2, 1.4, 0.5])


def test_the_description_shows_an_array_along_the_vehicle() -> None:
    roof = roof_array_56()
    extents = "0.00 m along x (forward), 0.78 m along y (left), 0.65 m along z (up)"
    assert stance(roof) == f"56 microphones, {extents}; front-back ambiguous"
    # A user wrote base_link axes into a file of Acoular's form.
    sideways = MicrophoneArray(roof.positions_m[:, [2, 0, 1]] * [1.0, -1.0, 1.0])
    assert "no extent across the vehicle" in stance(sideways)


def test_the_band_follows_the_spacing() -> None:
    assert default_band_hz(roof_array_56(), 47_998) == (300, 1800), "the band of the paper"
    for spacing_m, rate_hz, band_hz in (
        *((0.088, 48_000, (300, 1800)), (0.0419, 48_000, (600, 3600))),
        *((0.01, 48_000, (1200, 7200)), (0.01, 8_000, (600, 3600))),
    ):
        assert default_band_hz(MicrophoneArray([[0, spacing_m, 0], [0, 0, 0]]), rate_hz) == band_hz


@pytest.mark.parametrize(
    ("name", "microphones", "radius_m", "first_deg"),
    [
        ("respeaker-4", 4, 0.0405, 180),
        ("respeaker-6", 6, 0.0463, 120),
        ("respeaker-usb", 4, 0.032, 180),
        ("uma-8", 7, 0.043, 90),
        ("xmos", 7, 0.043, 240),
    ],
)
def test_a_board_is_known_by_its_name(name: str, microphones: int, radius_m: float, first_deg: float) -> None:
    array = read_array(name)
    assert (array.name, array.n_microphones, array.ambiguity) == (name, microphones, "up-down")
    ring = array.positions_m[microphones % 2 :]
    np.testing.assert_allclose(np.linalg.norm(ring, axis=1), radius_m, atol=1e-4)
    assert np.degrees(np.arctan2(ring[0, 1], ring[0, 0])) % 360 == pytest.approx(first_deg, abs=0.5)
    assert np.ptp(nearest_spacings_m(ring)) < 2e-4, "a regular ring"
    assert f"{1e3 * radius_m:g} mm" in named_arrays()[name]["source"]
    assert name in str(add_array_options.__doc__)


def test_the_first_microphone_of_a_square_board_is_below_right() -> None:
    array = read_array("uma-16")
    assert (array.n_microphones, array.ambiguity, array.channels) == (16, "front-back", ())
    np.testing.assert_allclose(array.aperture_m, [0.0, 0.126, 0.126])
    np.testing.assert_allclose(nearest_spacings_m(array.positions_m), 0.042)
    np.testing.assert_array_equal(array.positions_m[0], [0.0, -0.021, -0.063])


def test_a_file_precedes_a_name_and_an_unknown_name_lists_known_ones(tmp_path: Path) -> None:
    (tmp_path / "uma-8").write_text(SAME["plain.csv"])
    np.testing.assert_array_equal(read_array(tmp_path / "uma-8").positions_m, PLACES)
    known = "respeaker-4, respeaker-6, respeaker-usb, uma-8, uma-16, xmos"
    with pytest.raises(InputFileError, match=f"umma: .* one of {known}"):
        read_array("umma")
    with pytest.raises(InputFileError, match="expected no axes with the name of an array, got acoular"):
        read_array("xmos", "acoular")
