"""A model file with a sequence, from sound to snapshot, compared with streams on disk."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from made_up_sequence import sequence_model
from made_up_sound import THREE

from worldstate import Context, ListenSettings, NotUsable, WorldState
from worldstate.abduction.evidence import SideEvidence, SignatureEvidence
from worldstate.abduction.road_users import neutral
from worldstate.abduction.sequence.sequence_inputs import RECENT_HOPS
from worldstate.abduction.sequence.sequence_model import AlarmCurve, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.abduction.signature.ensemble import EnsembleModel, Expert
from worldstate.abduction.signature.window_classes import WINDOW_CLASSES
from worldstate.adapters import Step, listen_steps, open_source
from worldstate.adapters.acoustic import LEVEL_BAND_HZ
from worldstate.adapters.files.acoustic_domain import domain_of
from worldstate.adapters.files.model_file import KindShare, Model, read_model, save_model
from worldstate.commissioning.commission import stream_evidence
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import encode
from worldstate.operations.recordings.hop_table import HopTable
from worldstate.state import Hearing

RATE_HZ = 6000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write three seconds of modulated noise and a random model with a sequence."""
    place, rng = tmp_path_factory.mktemp("sequence"), np.random.default_rng(0)
    swelling = 0.01 * np.exp(np.sin(np.arange(3 * RATE_HZ) / RATE_HZ))[:, None]
    sound = rng.standard_normal((3 * RATE_HZ, 3)).cumsum(axis=1)
    soundfile.write(place / "sound.wav", swelling * sound, RATE_HZ)
    expert = Expert("mean", np.zeros(60), np.ones(60), 0.2 * rng.normal(size=(6, 60)), np.zeros(6))
    weights, domain = ((expert,), np.full(6, 1 / 6), np.zeros(180)), domain_of(THREE, [RATE_HZ], ["S1"])
    windows = EnsembleModel(*weights, np.zeros(60), domain=domain, classes=WINDOW_CLASSES)
    shipped, sequence = read_model(), sequence_model(rng, SequenceAlarm(0.0, 15.0))
    model = Model(windows, shipped.policies, shipped.provenance, sequence=sequence)
    save_model(place / "model.json", model)
    return place


def steps(folder: Path, model: Model | None = None, **options: object) -> Iterator[Step]:
    source = open_source(folder / "sound.wav", model=model or folder / "model.json", **options)  # type: ignore[arg-type]
    return listen_steps(source)


@pytest.fixture(scope="module")
def whole(folder: Path) -> list[Step]:
    return list(steps(folder))


def test_a_running_chain_equals_a_stream_on_disk(folder: Path, whole: list[Step]) -> None:
    heard, model, frames = whole, read_model(folder / "model.json"), [step.frame for step in whole]
    names = "feature", "band_log_energy", "prominence", "bearing_rad"
    columns = {name: np.array([getattr(one, name) for one in frames]) for name in names}
    # A rate that is not usable has no numbers.
    for name, field in (("looming_hz", "inverse_tta_hz"), ("looming_std_hz", "std_hz")):
        columns[name] = np.array([getattr(one.looming, field, np.nan) for one in frames])
    stream = HeardStream(HopTable(columns), HopTable({}), HopTable({}))
    assert isinstance(model.signature, EnsembleModel) and model.sequence is not None
    said = model.sequence.posterior(stream_evidence(model.signature, stream)).groups
    readings = [step.measurement.sequence for step in heard]
    assert [isinstance(one, NotUsable) for one in readings] == [True] * 9 + [False] * 12
    for reading, expected in zip(readings[9:], said[9:], strict=True):
        assert isinstance(reading, SequenceReading)
        np.testing.assert_allclose(reading.groups, expected, atol=1e-9)
    assert all(cue.within is not None for cue in heard[-1].state.cues)
    assert len(frames[0].band_log_energy) == 16 and LEVEL_BAND_HZ[1] == 0.45 * RATE_HZ


def test_the_snapshot_has_the_shares_of_the_exam_within_its_domain(folder: Path) -> None:
    model = read_model(folder / "model.json")
    card = replace(model.provenance, kinds=(KindShare("bicycle", 0.08, 12), KindShare("car", 0.78, 49)))
    known = replace(model, provenance=card)

    def heard(**more: object) -> Hearing:
        (one,) = next(steps(folder, known, **more)).state.heard
        return one

    here = heard()
    assert here.kinds == pytest.approx({"bicycle": 0.08 * here.share, "car": 0.78 * here.share}, abs=5e-4)
    anywhere = ListenSettings(uncalibrated=True)
    assert heard(settings=anywhere).kinds is heard(context=Context(ego_speed_mps=5.0)).kinds is None


def test_outside_of_its_domain_a_sequence_has_a_reason(folder: Path) -> None:
    moving = next(steps(folder, context=Context(ego_speed_mps=5.0))).state
    assert moving.no_sequence == NotUsable("the model was made for a standing ego, this one is moving")
    model = read_model(folder / "model.json")
    domain = replace(model.signature.domain, ego_motion="moving")
    driven = replace(model, signature=replace(model.signature, domain=domain))
    contexts = Context(), Context(ego_speed_mps=5.0)
    stands, moves = (next(steps(folder, driven, context=one)).state for one in contexts)
    assert stands.no_sequence == NotUsable("the model was made for a moving ego, this one is standing")
    assert (
        moves.no_sequence is not None and "made for" not in moves.no_sequence.reason
    )  # The sound is too short so far
    other = replace(THREE, positions_m=1.1 * THREE.positions_m)
    free = next(steps(folder, array=other, settings=ListenSettings(uncalibrated=True))).state
    assert free.no_sequence is not None and free.no_sequence.reason.startswith("uncalibrated")
    unfit = replace(model, provenance=replace(model.provenance, fit_for_use=False))
    quick = next(steps(folder, unfit)).state
    assert quick.no_sequence == NotUsable("the model is marked as unfit for use")
    without = next(steps(folder, replace(model, sequence=None))).state
    assert without.no_sequence is not None and "model make" in without.no_sequence.reason
    assert {cue.within for state in (moving, free, quick, without) for cue in state.cues} == {None}


def test_foreign_sounds_lose_evidence_of_each_side() -> None:
    sides = SideEvidence(("left", "right"), (3.0, -1.0), 0.1, 0.1, 0.5)
    heard = neutral(SignatureEvidence(("left", "right"), (3.0, -1.0), -2.0, 0.5, sides), margin=2.0)
    assert heard.sides == replace(sides, log_ratios=(1.0, 0.0))


def lossy(folder: Path, tmp_path: Path, seconds: float) -> tuple[list[Step], list[Step]]:
    """Process eight seconds of noise with and without a loss after three seconds."""
    rng = np.random.default_rng(5)
    # A wave from ahead, so that no microphone seems faulty.
    sound = 0.01 * (rng.standard_normal((8 * RATE_HZ, 1)) + 0.3 * rng.standard_normal((8 * RATE_HZ, 3)))
    heard = []
    for name, lost in (("lossy.wav", round(seconds * RATE_HZ)), ("whole.wav", 0)):
        hurt = sound.copy()
        hurt[3 * RATE_HZ : 3 * RATE_HZ + lost] = 0.0
        soundfile.write(tmp_path / name, hurt, RATE_HZ)
        source = open_source(tmp_path / name, model=folder / "model.json", array=THREE)
        heard.append(list(listen_steps(source)))
    return heard[0], heard[1]


@pytest.mark.long
def test_lost_sound_is_no_evidence_and_has_no_later_effect(folder: Path, tmp_path: Path) -> None:
    hurt, whole = lossy(folder, tmp_path, 1.0)
    unheard = [step.measurement for step in hurt if not step.measurement.heard.usable]
    # From the first lost hop until 40 % of the window is usable again.
    assert [one.stamp_ns // 10**8 for one in unheard] == [*range(31, 44)]
    assert {one.sequence for one in unheard} == {NotUsable("lost samples")}
    ends = [steps[-1].checkpoint for steps in (hurt, whole)]
    assert ends[0].site is not None and ends[1].site is not None
    assert ends[0].site.heard_s == pytest.approx(ends[1].site.heard_s - 1.3, abs=0.05)
    assert ends[0].history is not None and ends[1].history is not None
    assert len(ends[0].history.minute) == len(ends[1].history.minute) - 13
    # Level, loudness and prominence of the last hops equal those without a loss.
    recent = [end.history.recent[1 - RECENT_HOPS :, 3:6] for end in ends if end.history is not None]
    np.testing.assert_allclose(recent[0], recent[1], atol=1e-9)


@pytest.mark.long
def test_history_survives_a_short_loss_only(folder: Path, tmp_path: Path) -> None:
    for seconds, first in ((1.0, ""), (4.0, "less than 10 hops of evidence")):
        said = [step.measurement.sequence for step in lossy(folder, tmp_path, seconds)[0]]
        reasons = [one.reason if isinstance(one, NotUsable) else "" for one in said]
        assert reasons[len(reasons) - reasons[::-1].index("lost samples")] == first


def curved(folder: Path) -> Model:
    """Return the model with an alarm curve whose thresholds span the log-odds of its sound."""
    model = read_model(folder / "model.json")
    silent = replace(model.sequence, alarm=SequenceAlarm(1e6, 15.0))
    heard = [step.state for step in steps(folder, replace(model, sequence=silent))]
    nats = np.array([[cue.evidence.compared_nats for cue in state.cues] for state in heard[9:]]).max(axis=1)
    rates = np.array([[0.0, 6.0, 30.0], [0.0, 3.0, 20.0], [3.0, 12.0, 45.0]])
    points = [np.array([nats.max() + 1.0, nats.max(), nats.min()]), *rates, *(rates / 600.0)]
    curve = AlarmCurve(*points, hours=2.0, least_onsets=3.0)
    return replace(model, sequence=replace(model.sequence, alarm=curve.default(6.0), curve=curve))


def advised(folder: Path, model: Model, **asked: float) -> tuple[int, WorldState]:
    """Return the number of advisories of all hops and sides, and the last snapshot."""
    states = [step.state for step in steps(folder, model, **asked)]
    return sum(cue.advisory is not None for state in states for cue in state.cues), states[-1]


def test_a_requested_budget_sets_threshold_and_promise(folder: Path) -> None:
    model = curved(folder)
    few, quiet = advised(folder, model, budget=6.0)
    many, loud = advised(folder, model, budget=30.0)
    shares = [advised(folder, model, alpha=alpha)[0] for alpha in (0.01, 0.05)]
    assert shares == [few, many] and few < many
    assert advised(folder, model)[0] == few, "the file's own budget"
    for state, budget, alpha in ((quiet, 6.0, 0.01), (loud, 30.0, 0.05)):
        told = state.budget
        assert told is not None and told.promise is not None
        assert (told.onsets_per_hour, told.asked_alpha, told.promise.alpha) == (budget, None, alpha)
        assert [cue.alpha for cue in state.cues] == [alpha, alpha]
        assert WorldState.from_json(state.to_json()) == state
    told = advised(folder, model, alpha=0.02)[1].budget
    assert told is not None and (told.asked_alpha, told.onsets_per_hour) == (0.02, 6.0)


def test_an_unsupported_budget_is_refused_with_the_range(folder: Path) -> None:
    model, only = curved(folder), read_model(folder / "model.json")
    plain = replace(only, sequence=None)
    assert advised(folder, only, budget=15.0)[1].budget.onsets_per_hour == 15.0  # type: ignore[union-attr]
    for refused, asked, words in (
        (model, {"budget": 1.4}, "budget: expected 1.5 to 30 onsets per hour"),
        (model, {"alpha": 0.06}, "alpha: expected 0.01 to 0.05 of the hops"),
        (model, {"alpha": 0.02, "budget": 6.0}, "budget, alpha: expected one of them"),
        (only, {"budget": 6.0}, "budget: expected a model file with a curve .* only 15 onsets per hour"),
        (only, {"alpha": 0.02}, "alpha: expected a model file with a curve .* `worldstate model make`"),
        (plain, {"budget": 6.0}, "budget: expected a model with a sequence .*model make"),
        (plain, {"alpha": 0.03}, "alpha: expected a calibrated budget"),
    ):
        with pytest.raises(InvalidArgumentError, match=words):
            open_source(folder / "sound.wav", model=refused, **asked)  # type: ignore[arg-type]
    assert open_source(folder / "sound.wav", model=plain, alpha=0.05).policy.alpha == 0.05


def test_a_model_file_keeps_its_curve_or_single_alarm(folder: Path, tmp_path: Path) -> None:
    model = curved(folder)
    save_model(tmp_path / "curve.json", model)
    kept = read_model(tmp_path / "curve.json")
    assert kept.sequence is not None and model.sequence is not None
    assert encode(kept.sequence) == encode(model.sequence)
    former = json.loads((tmp_path / "curve.json").read_text())
    del former["sequence"]["curve"]
    former["sequence"]["alarm"] = {"threshold_nats": -0.5, "onsets_per_hour": 40.0}
    (tmp_path / "former.json").write_text(json.dumps(former))
    read = read_model(tmp_path / "former.json").sequence
    assert read is not None and read.curve is None and read.alarm == SequenceAlarm(-0.5, 40.0)
