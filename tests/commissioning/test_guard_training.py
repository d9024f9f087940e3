"""Training of a guard on known clusters and simulated sounds."""

from dataclasses import replace

import numpy as np
import pytest
from worldstate_lab.cli.foreign import guard_exam

from worldstate.abduction.road_users import Foreign, WarningSignal
from worldstate.adapters.files.model_file import read_model
from worldstate.commissioning.guard_training import (
    FLAGGED,
    FOREIGN,
    SIGNALS,
    STREET,
    SoundRows,
    fit_guard,
    rows_of_clip,
    sound_rows,
    street_excesses,
    street_rows,
    threshold_of,
)
from worldstate.commissioning.heard_stream import hear_stream, junction_named
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.frontend.spectra.sound_character import MEASURES
from worldstate.ground.serialisation import encode
from worldstate.simulation.stream.settings import StreamSettings, traffic_named

SITES, EACH = ("one", "two", "three"), 60


def made_up_rows(seed: int, apart: float = 10.0) -> SoundRows:
    """Draw clusters: streets at the origin, each kind of sound on its own axis."""
    rng = np.random.default_rng(seed)
    kinds = [kind for kind in (*STREET, *FOREIGN, *SIGNALS) for _ in range(EACH)] * len(SITES)
    sites = np.repeat(SITES, len(kinds) // len(SITES))
    centres = {kind: apart * np.eye(len(MEASURES))[i] for i, kind in enumerate((*FOREIGN, *SIGNALS))}
    middle = np.array([centres.get(kind, np.zeros(len(MEASURES))) for kind in kinds])
    return SoundRows(middle + rng.standard_normal(middle.shape), np.array(kinds), sites)


def test_new_streets_have_the_stated_false_rate() -> None:
    rows, fresh = made_up_rows(1), made_up_rows(2)
    guard = fit_guard(rows, threshold_of(list(street_excesses(rows).values())))
    street = np.isin(fresh.kinds, STREET)
    share = float((guard.log_odds(fresh.measures[street]) > 0.0).mean())
    # 540 hops: three standard deviations of a share of 0.025.
    assert share < FLAGGED + 3.0 * np.sqrt(FLAGGED / street.sum())
    # At even odds, because a trained guard calls many sounds signals in order to miss few.
    guard = replace(guard, signal_nats=0.0)
    for kind, expected in (("voice", Foreign), ("rain", Foreign), ("wail", WarningSignal)):
        verdicts = [guard.judge(one) for one in fresh.measures[fresh.kinds == kind]]
        assert np.mean([isinstance(one, expected) for one in verdicts]) > 0.85
    assert len(str(encode(guard))) < 60_000


def test_streets_with_other_sounds_set_no_threshold() -> None:
    """Its hops are learned as street, but music called foreign is no false call."""
    pair = MicrophoneArray([[0.0, 0.3, 1.7], [0.0, -0.3, 1.7]])
    for name in ("empty", "music"):
        settings = StreamSettings(junction_named("SA101"), 0.2, 1, traffic_named(name), sample_rate_hz=6000.0)
        kinds = set(street_rows(hear_stream(settings, [pair])[0]).kinds.tolist())
        assert kinds == ({"none"} if name == "empty" else {""})
    assert threshold_of([]) == -np.inf


@pytest.mark.long
def test_the_shipped_guard_accepts_motorcycles_and_not_machines() -> None:
    """Clips of new seeds, passing and standing, of other recorders."""
    guard = read_model(None).guard
    assert guard is not None
    familiar = {}
    for name in ("motorcycle", "idling motorcycle", "light", "jackhammer", "saw"):
        clips = [rows_of_clip(6000.0, (name, i, np.random.default_rng([55, i]))) for i in range(20)]
        shares = [(guard.log_odds(one.measures[:, : len(MEASURES)]) <= 0.0).mean() for one in clips]
        familiar[name] = float(np.mean(shares))
    assert min(familiar["motorcycle"], familiar["idling motorcycle"], familiar["light"]) > 0.85
    assert max(familiar["jackhammer"], familiar["saw"]) < 0.7


@pytest.mark.slow
def test_an_exam_excludes_its_own_sounds() -> None:
    # On orthogonal axes one learned kind gives no information about another.
    found = {(one.without, one.kind): one for one in guard_exam(made_up_rows(3))}
    known, unknown = found["nothing", "voice"], found["voice", "voice"]
    assert known.foreign > 0.85
    assert unknown.foreign + unknown.signal < 0.5
    assert found["nothing", "siren"].signal > 0.7
    groups = "ringing", "tools", "impacts", "speech", "music", "animals"
    assert {one for one, _ in found} == {"nothing", *FOREIGN, *groups}
    assert all(found["nothing", label].foreign < 0.1 for label in STREET)


@pytest.mark.slow
def test_simulated_sounds_exceed_the_ambience() -> None:
    rows = sound_rows(ovad_array(), 6000.0, ("SB1", np.random.default_rng(1)))
    assert set(rows.kinds.tolist()) <= {*FOREIGN, *SIGNALS}
    assert {"voice", "music", "siren"} <= set(rows.kinds.tolist())
    # Speech is modulated at 2.8 to 6.2 Hz in all bands at once, a steady tone hardly.
    column = MEASURES.index("modulation high 2.8")
    speech, tone = (rows.measures[rows.kinds == kind][:, column].mean() for kind in ("voice", "tone"))
    assert speech > tone + 0.5
