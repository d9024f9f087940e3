"""Model files: a written file reads back bit for bit; a damaged file raises an error with its name."""

import copy
import gzip
import json
import tracemalloc
from dataclasses import replace
from functools import reduce
from operator import getitem

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.published_signature import SignatureModel
from worldstate.adapters.files import array_file
from worldstate.adapters.files.array_file import named_arrays, read_array
from worldstate.adapters.files.file_io import MAX_BYTES, refused_as_file
from worldstate.adapters.files.model_file import Model, read_model, save_model
from worldstate.belief.street_model import Number, StreetModel, StreetNumbers
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InputFileError, WorldstateError
from worldstate.ground.serialisation import decode, encode


def read(data: object) -> Model:
    with refused_as_file("bad.json"):
        return decode(Model, data, "model")


def published():
    """Return the shipped model with the published classifier as its signature and only 40 trees."""
    rng = np.random.default_rng(0)
    mean, scale, coefficients = rng.normal(size=60), np.ones(60), rng.normal(size=(6, 60))
    signature = SignatureModel(mean, scale, coefficients, *rng.normal(size=(3, 6)), np.full(4, 0.25))
    shipped, grids = read_model(), ("split", "threshold", "yes", "no", "value", "tree_class")
    few = {name: getattr(shipped.sequence.trees, name)[:40] for name in grids}
    sequence = replace(shipped.sequence, trees=replace(shipped.sequence.trees, **few))
    return replace(shipped, signature=signature, sequence=sequence)


DEFAULT, DOMAIN = encode(published()), read_model().domain
PLAIN_MODEL = json.dumps(DEFAULT).encode()
PACKED_MODEL = gzip.compress(PLAIN_MODEL)


def paths(value, here=()):
    """Yield the paths of all values in decoded JSON, with only the first item of each list."""
    yield here
    if isinstance(value, list):
        value = dict(enumerate(value[:1]))
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from paths(inner, (*here, key))


def at(data, path):
    return reduce(getitem, path, data)


def replaced(data, path, value):
    data = copy.deepcopy(data)
    at(data, path[:-1])[path[-1]] = value
    return data


PATHS = [path for path in paths(DEFAULT) if path]
# The shipped signature in the same file, as only this part differs.
ENSEMBLE = DEFAULT | {"signature": encode(read_model())["signature"]}
ENSEMBLE_PATHS = [path for path in paths(ENSEMBLE) if path[:1] == ("signature",)]
PLACES = st.one_of(
    st.tuples(st.just(data), st.sampled_from(some))
    for data, some in ((DEFAULT, PATHS), (ENSEMBLE, ENSEMBLE_PATHS))
)


def test_a_tree_with_a_single_leaf_is_read_from_a_file(tmp_path):
    trees = read_model().sequence.trees
    alone = {name: np.array(getattr(trees, name)[:3]) for name in ("yes", "no", "split", "threshold")}
    alone["yes"][0] = alone["no"][0] = np.arange(alone["yes"].shape[1])
    few = {name: getattr(trees, name)[:3] for name in ("value", "tree_class")}
    model = published()
    sequence = replace(model.sequence, trees=replace(trees, **alone, **few))
    save_model(tmp_path / "model.json", replace(model, sequence=sequence))
    read = read_model(tmp_path / "model.json").sequence.trees
    np.testing.assert_array_equal(read.yes, alone["yes"])


def test_the_shipped_model_has_its_provenance_and_ordered_thresholds():
    model = read_model()
    assert isinstance(model.signature, EnsembleModel) and model.provenance.dataset
    assert None not in (model.sequence, model.guard, model.road_users)
    # All listeners of a process share the arrays, so they are read-only.
    assert read_model().sequence is model.sequence and not model.sequence.trees.split.flags.writeable
    thresholds = [model.policies.for_alpha(alpha).gamma for alpha in (0.05, 0.02, 0.01)]
    assert thresholds == sorted(thresholds)


def test_a_caller_cannot_change_the_shipped_model_of_another():
    once, again = read_model(), read_model()
    with pytest.raises(ValueError, match="read-only"):
        once.signature.home[0] = 99.0
    once.provenance.figures["accuracy"] = once.provenance.exam["detected"] = 2.0
    assert read_model().provenance.figures["accuracy"] < 1.0
    assert again.provenance.figures["accuracy"] < 1.0 and again.provenance.exam["detected"] <= 1.0


@pytest.mark.parametrize("made", [published, read_model])
def test_written_and_read_back_to_the_bit(made, tmp_path):
    save_model(tmp_path / "m", made())
    assert [p.name for p in tmp_path.iterdir()] == ["m"]
    assert encode(read_model(tmp_path / "m")) == encode(made())


def test_a_packed_file_equals_the_plain_one_and_is_reproducible(tmp_path):
    names = ("m.json", "m.json.gz", "again.json.gz")
    for name in names:
        save_model(tmp_path / name, published())
    plain, packed, again = ((tmp_path / name).read_bytes() for name in names)
    assert gzip.decompress(packed) == plain and packed == again and len(packed) < len(plain) / 2
    assert encode(read_model(tmp_path / "m.json.gz")) == DEFAULT


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
@given(st.sampled_from(["bad.json", "bad.json.gz"]), st.floats(0, 0.999), st.booleans())
def test_a_damaged_file_is_refused_by_name(tmp_path, name, place, is_cut):
    data = bytearray(PACKED_MODEL if name.endswith("gz") else PLAIN_MODEL)
    at = int(place * len(data))
    if is_cut or name == "bad.json":
        del data[at:]
    else:
        data[at] ^= 0xFF
    (tmp_path / name).write_bytes(data)
    try:
        model = read_model(tmp_path / name)
    except InputFileError as error:
        assert name in str(error)
    else:  # The time stamp in the gzip header is not checked
        assert name != "bad.json" and encode(model) == DEFAULT


def test_a_packed_file_is_unpacked_only_up_to_the_size_limit(tmp_path):
    """One gigabyte of blanks compresses to one megabyte."""
    bomb, unpacked = tmp_path / "bomb.json.gz", b" " * (1 << 20)
    with gzip.open(bomb, "wb", compresslevel=1) as file:
        for _ in range(1024):
            file.write(unpacked)
    tracemalloc.start()
    with pytest.raises(InputFileError, match=r"bomb\.json\.gz: expected a model file of at most"):
        read_model(bomb)
    assert tracemalloc.get_traced_memory()[1] < 3 * MAX_BYTES
    tracemalloc.stop()


BOARDS = st.sampled_from(sorted(named_arrays()))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=20, deadline=None)
@given(ships=BOARDS, other=BOARDS, moved_m=st.floats(-1.0, 1.0), seed=st.integers(0, 100))
def test_the_model_of_a_board_is_found_by_its_positions(
    tmp_path_factory, monkeypatch, ships, other, moved_m, seed
):
    """The array has a name or is a file with channels in any order; other boards use the roof model."""
    monkeypatch.setattr(array_file, "MODELS", tmp_path_factory.mktemp("models"))
    board = read_array(ships)
    domain = replace(published().signature.domain or DOMAIN, array=ships, positions_m=board.positions_m)
    made = replace(published(), signature=replace(published().signature, domain=domain))
    save_model(array_file.MODELS / f"{ships}.json.gz", made)
    shuffled = np.random.default_rng(seed).permutation(board.positions_m) + moved_m
    for array in (board, MicrophoneArray(shuffled, "mine.csv")):
        assert read_model(array=array).domain.array == ships
    assert read_model(ships).domain.array == ships
    assert read_model().domain.array.startswith("OVAD")
    expected = ships if other == ships else "OVAD (Schulz et al. 2021)"
    assert read_model(array=read_array(other)).domain.array == expected


def test_the_numbers_of_the_belief_come_back_with_their_sources(tmp_path):
    fitted = Number(0.4, "T_l", "s", "fitted", "likelihood of ten streams")
    street = StreetModel.of(StreetNumbers({"look_s": fitted}))
    save_model(tmp_path / "street.json", replace(read_model(), street=replace(street, works=0.9)))
    back = read_model(tmp_path / "street.json").street
    assert back == replace(StreetModel(), look_s=0.4, works=0.9)
    assert back.described["look_s"] == fitted and back.described["works"].origin == "given"
    assert back.described["fails_s"] == StreetModel().described["fails_s"]
    with pytest.raises(InputFileError, match="look_s: expected a number in 's'"):
        read(DEFAULT | {"street": encode(StreetNumbers({"look_s": replace(fitted, unit="ms")}))})


@given(st.dictionaries(st.sampled_from(sorted(StreetModel().described)), st.floats(0.01, 0.9), min_size=1))
@settings(max_examples=20, deadline=None)
def test_a_checkpoint_holds_the_numbers_of_its_street(values):
    now = WorldFilter()
    now = replace(now, settings=replace(now.settings, street=StreetModel(**values)))
    back = WorldFilter.from_dict(json.loads(json.dumps(now.to_dict())))
    assert back.settings.street == now.settings.street
    changed = {name for name, one in back.settings.street.described.items() if one.origin == "given"}
    assert changed <= {*values}


WRONG = [None, True, "text", [], {}, [None], -1.5, 10**400, float("nan"), float("inf"), "1.0", ["1.0"]]


@settings(max_examples=300, deadline=None)
@given(PLACES, st.sampled_from(WRONG))
def test_wrong_values_are_refused_or_harmless(place, value):
    try:
        model = read(replaced(*place, value))
    except WorldstateError as error:
        assert str(error).startswith("bad.json")
    else:
        json.dumps(encode(model), allow_nan=False)
        inputs = np.zeros((1, model.signature.n_features))
        assert np.isfinite(model.signature.predict_proba(inputs)).all()


NUMBERS = [path for path in paths(DEFAULT) if type(at(DEFAULT, path)) is float and path[0] != "provenance"]


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning", "ignore:invalid:RuntimeWarning")
@pytest.mark.parametrize("path", NUMBERS, ids=lambda path: ".".join(map(str, path)))
def test_a_number_that_would_overflow_is_refused(path, tmp_path):
    for value in (1e308, -1e308, 1e15):
        (tmp_path / "m.json").write_text(json.dumps(replaced(DEFAULT, path, value)))
        with pytest.raises(InputFileError):
            read_model(tmp_path / "m.json")


def test_missing_and_huge_files_are_refused(tmp_path):
    huge = tmp_path / "huge.json"
    with huge.open("wb") as file:
        file.truncate(1 << 30)
    for path in (huge, tmp_path / "missing.json", tmp_path):
        with pytest.raises(InputFileError, match=path.name):
            read_model(path)
