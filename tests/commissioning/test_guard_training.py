"""Training a guard on rows whose clusters are known, and on sounds of the simulator."""

import numpy as np
import pytest
from worldstate_lab.cli.foreign import guard_exam

from worldstate.abduction.road_users import Foreign, WarningSignal
from worldstate.commissioning.guard_training import (
    FLAGGED,
    FOREIGN,
    SIGNALS,
    STREET,
    SoundRows,
    fit_guard,
    sound_rows,
    street_excesses,
    threshold_of,
)
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.frontend.spectra.sound_character import MEASURES
from worldstate.ground.serialisation import encode

SITES, EACH = ("one", "two", "three"), 60


def made_up_rows(seed: int, apart: float = 10.0) -> SoundRows:
    """Draw clusters: streets at the origin, each kind of sound on an axis of its own."""
    rng = np.random.default_rng(seed)
    kinds = [kind for kind in (*STREET, *FOREIGN, *SIGNALS) for _ in range(EACH)] * len(SITES)
    sites = np.repeat(SITES, len(kinds) // len(SITES))
    centres = {kind: apart * np.eye(len(MEASURES))[i] for i, kind in enumerate((*FOREIGN, *SIGNALS))}
    middle = np.array([centres.get(kind, np.zeros(len(MEASURES))) for kind in kinds])
    return SoundRows(middle + rng.standard_normal(middle.shape), np.array(kinds), sites)


def test_streets_never_heard_are_flagged_as_often_as_stated_and_sounds_are_found() -> None:
    rows, fresh = made_up_rows(1), made_up_rows(2)
    guard = fit_guard(rows, threshold_of(list(street_excesses(rows).values())))
    street = np.isin(fresh.kinds, STREET)
    share = float((guard.log_odds(fresh.measures[street]) > 0.0).mean())
    # 540 hops: three standard deviations of a share of .025.
    assert share < FLAGGED + 3.0 * np.sqrt(FLAGGED / street.sum())
    for kind, expected in (("voice", Foreign), ("rain", Foreign), ("wail", WarningSignal)):
        verdicts = [guard.judge(one) for one in fresh.measures[fresh.kinds == kind]]
        assert np.mean([isinstance(one, expected) for one in verdicts]) > 0.85
    assert len(str(encode(guard))) < 60_000


@pytest.mark.slow
def test_an_exam_leaves_out_what_it_asks_for() -> None:
    # On orthogonal axes nothing learned of one kind tells another: a guard that had heard it would.
    found = {(one.without, one.kind): one for one in guard_exam(made_up_rows(3))}
    known, unknown = found["nothing", "voice"], found["voice", "voice"]
    assert known.foreign > 0.85
    assert unknown.foreign + unknown.signal < 0.5
    assert found["nothing", "siren"].signal > 0.7
    assert {one for one, _ in found} == {
        "nothing",
        *FOREIGN,
        "ringing",
        "tools",
        "impacts",
        "speech",
        "music",
        "animals",
    }
    assert all(found["nothing", label].foreign < 0.1 for label in STREET)


@pytest.mark.slow
def test_sounds_of_the_simulator_are_heard_above_the_ambience() -> None:
    rows = sound_rows(ovad_array(), "SB1", 6000.0, np.random.default_rng(1))
    assert set(rows.kinds.tolist()) <= {*FOREIGN, *SIGNALS}
    assert {"voice", "music", "siren"} <= set(rows.kinds.tolist())
    # Speech is modulated at 2.8 to 6.2 Hz in all bands at once, a steady tone hardly.
    column = MEASURES.index("modulation high 2.8")
    speech, tone = (rows.measures[rows.kinds == kind][:, column].mean() for kind in ("voice", "tone"))
    assert speech > tone + 0.5
