"""A guard in the acoustic adapter reduces the evidence of foreign sounds, not of warning signals."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import ArrayLike

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.road_users import DomainGuard, Familiar, Foreign, WarningSignal
from worldstate.adapters.acoustic import FOREIGN, AcousticAdapter
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.feature import feature_nfft
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.sound_character import MEASURES
from worldstate.ground.errors import OutOfDomainError
from worldstate.measurement.measurement import Heard
from worldstate.state.world_state import WorldState

RATE_HZ = 6000
ARRAY = MicrophoneArray([[0.0, 0.2, 0.0], [0.0, 0.0, 0.0], [0.0, -0.3, 0.0]])
# Independent noise is unusable if channels are watched.
UNWATCHED = FrontEndSettings(nfft=feature_nfft(RATE_HZ), watch_channels=False)
unwatched = partial(AcousticAdapter, ARRAY, RATE_HZ, front_end_settings=UNWATCHED)
STEADY, SHARED = MEASURES.index("line holds"), MEASURES.index("together 2.2")


class Alarmed:
    """A model with constant evidence of a vehicle on the left."""

    def evidence(self, feature: ArrayLike, /) -> SignatureEvidence:
        return SignatureEvidence(("left", "right"), (3.0, 0.0), -2.0, -1.0)


class Silent:
    """A model with constant evidence of no vehicle, beyond the margin of any guard."""

    def evidence(self, feature: ArrayLike, /) -> SignatureEvidence:
        return SignatureEvidence(("left", "right"), (-6.0, -6.0), -2.0, 0.0)


def guard() -> DomainGuard:
    """Return a guard for common modulation (foreign) and a steady line (signal)."""
    weights = np.zeros((3, len(MEASURES)))
    weights[1, SHARED], weights[2, STEADY] = 12.0, 20.0
    return DomainGuard(
        measures=MEASURES,
        foreign=("speech",),
        signals=("siren",),
        weights=weights,
        biases=np.array([12.0, 0.0, 0.0]),
        threshold=0.0,
    )


def sounds() -> dict[type, np.ndarray]:
    """Return three seconds of noise, of noise modulated at 4 Hz, and of a tone."""
    rng, time = np.random.default_rng(1), np.arange(3 * RATE_HZ) / RATE_HZ
    noise = 0.02 * rng.standard_normal((len(time), 3))
    swelling = noise * (1.05 + np.sin(8.0 * np.pi * time))[:, None]
    tone = noise + 0.2 * np.sin(2.0 * np.pi * 700.0 * time)[:, None]
    return {Familiar: noise, Foreign: swelling, WarningSignal: tone}


@pytest.mark.parametrize("kind", [Familiar, Foreign, WarningSignal])
def test_only_foreign_sounds_lose_evidence(kind: type) -> None:
    measured = unwatched(Alarmed(), guard=guard()).measure(sounds()[kind])
    assert [one.domain for one in measured[:11]] == [None] * 11
    last, plain = measured[-1], unwatched(Alarmed()).measure(sounds()[kind])[-1]
    assert isinstance(last.domain, kind)
    said = [value - plain.signature.none for value in plain.signature.hidden]
    heard = [value - last.signature.none for value in last.signature.hidden]
    less = [max(value - 2.0, 0.0) for value in said] if kind is Foreign else said
    assert min(said) >= 0.0
    assert heard == pytest.approx(less, abs=1e-6)
    unknown = 1.0 / (1.0 + np.exp(last.domain.log_odds)) if isinstance(last.domain, Foreign) else 1.0
    assert last.heard.share == pytest.approx(plain.heard.share * unknown)
    assert (last.heard.reason == FOREIGN) == isinstance(last.domain, Foreign)
    world = WorldFilter()
    for one in measured:
        world = world.update(one)
    again = WorldState.from_json(world.state.to_json())
    assert again.domain == last.domain
    if isinstance(last.domain, Foreign):
        assert again.to_dict()["domain"]["reason"] == "sounds like speech"


def test_a_foreign_sound_is_not_taken_for_silence() -> None:
    adapter = unwatched(Silent(), guard=guard())
    foreign = [one for one in adapter.measure(sounds()[Foreign]) if isinstance(one.domain, Foreign)]
    warned = WorldFilter()
    for one in unwatched(Alarmed()).measure(sounds()[Familiar]):
        warned = warned.update(one)
    later = [replace(one, stamp_ns=warned.stamp_ns + 10**8 * (i + 1)) for i, one in enumerate(foreign[:5])]
    carried, silent, waited = warned, warned, warned.predict_to(later[-1].stamp_ns)
    for one in later:
        carried = carried.update(one)
        silent = silent.update(replace(one, heard=Heard()))
    left = [one.belief.hypotheses[0] for one in (silent, carried, waited)]
    assert left[0] < 0.5 * left[2]
    assert left[1] == pytest.approx(left[2], rel=0.2)


def test_a_guard_of_other_measures_is_refused() -> None:
    one = guard()
    renamed = DomainGuard(
        ("loudness", *MEASURES[1:]), *(one.foreign, one.signals, one.weights, one.biases, one.threshold)
    )
    with pytest.raises(OutOfDomainError, match="guard"):
        unwatched(Alarmed(), guard=renamed)
