"""Ego-noise where people listen: the filter's belief opens and shuts the gate, end to end."""

from pathlib import Path

import numpy as np
import pytest
import scipy.signal
import soundfile

from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.listener import listen_steps
from worldstate.adapters.source import ListenSettings, Source, open_source
from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import AcousticFrame
from worldstate.ground.errors import InvalidArgumentError
from worldstate.simulation.dataset.recording import FULL_SCALE_PA
from worldstate.simulation.sound.ego_sound import ego_noise

RATE, SECONDS, APPEARS_S = 16_000, 6.0, 4.5
ARRAY = roof_array_56()


def drive(source_deg: float) -> np.ndarray:
    """Drive at 5 m/s; a source of the same colour, 15 dB below it in the band of SRP, comes late, (n, M)."""
    rng, n = np.random.default_rng(150), round(SECONDS * RATE)
    mounted = ARRAY.centred_m + np.array([0.0, 0.0, 1.7])
    noise = ego_noise(mounted, np.full(n, 5.0), RATE, rng)
    frequencies = np.fft.rfftfreq(n, 1 / RATE)
    band = (frequencies > 300) & (frequencies < 1800)
    grid, density = scipy.signal.welch(noise, RATE, nperseg=512, axis=0)
    colour = np.sqrt(np.interp(frequencies, grid, density.mean(axis=1))) * band
    wave = np.fft.rfft(rng.standard_normal(n))[:, None] * colour[:, None]
    wave = np.fft.irfft(wave * ARRAY.steering(frequencies, np.radians(source_deg))[:, :, 0], n, axis=0)
    heard = np.fft.irfft(np.fft.rfft(noise, axis=0) * band[:, None], n, axis=0)
    wave *= 10 ** (-15 / 20) * heard.std() / wave.std()
    wave[: round(APPEARS_S * RATE)] = 0.0
    return np.asarray((noise + wave) / FULL_SCALE_PA, np.float32)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "drive.wav"
    soundfile.write(path, drive(35.0), RATE, subtype="FLOAT")
    return path


def opened(recording: Path, ego_noise: bool) -> Source:
    """The model that ships knows neither this array nor this rate."""
    settings = ListenSettings(ego_noise=ego_noise, uncalibrated=True)
    return open_source(recording, array=ARRAY, settings=settings)


@pytest.mark.long
def test_a_source_under_ego_noise_is_pointed_at_once_the_noise_is_known(recording: Path) -> None:
    bearings = {}
    for ego in (False, True):
        steps = list(listen_steps(opened(recording, ego)))
        late = [step.frame for step in steps if step.frame.stamp_ns > (APPEARS_S + 0.4) * 1e9]
        bearings[ego] = np.degrees([frame.bearing_rad for frame in late])
    assert len(bearings[True]) > 8
    assert np.abs(bearings[True] - 35.0).max() < 3.0
    assert np.median(np.abs(bearings[False] - 35.0)) > 10.0


def frames(source: Source, none_probability: float | None = None) -> list[AcousticFrame]:
    """Hear a recording hop by hop, with one belief that nothing is there, or none."""
    uncalibrated, settings = source.settings.uncalibrated, source.settings.front_end(source.array, RATE)
    adapter = AcousticAdapter(
        *(source.array, RATE, source.signature()), front_end_settings=settings, uncalibrated=uncalibrated
    )
    heard = []
    with open_sound(source.sound) as audio:
        for hop in audio.blocks(RATE // 10):
            heard += adapter.front_end.process(hop)
            if heard and none_probability is not None:
                adapter.set_no_source_probability(none_probability)
    return heard


def test_it_is_off_unless_asked_and_where_nobody_believes(recording: Path) -> None:
    plain = [frame.srp for frame in frames(opened(recording, False))]
    for belief in (None, 0.3):
        unlearned = [frame.srp for frame in frames(opened(recording, True), belief)]
        np.testing.assert_array_equal(plain, unlearned)
    assert np.abs(frames(opened(recording, True), 1.0)[-1].srp - plain[-1]).max() > 0.02


def test_the_signature_hears_what_it_was_trained_with(recording: Path) -> None:
    """The posterior is the same, hop by hop: only spatial spectrum, bearing and prominence change."""
    plain, learned = (list(listen_steps(opened(recording, ego))) for ego in (False, True))
    for a, b in zip(plain, learned, strict=True):
        assert a.measurement.signature == b.measurement.signature


def test_a_belief_out_of_range_is_refused_and_without_ego_noise_ignored() -> None:
    class Flat:
        def evidence(self, feature: object, /) -> None: ...

    settings = FrontEndSettings(nfft=256, ego_noise=True)
    learning = AcousticAdapter(ARRAY, RATE, Flat(), front_end_settings=settings)  # type: ignore[arg-type]
    with pytest.raises(InvalidArgumentError, match="none_probability"):
        learning.set_no_source_probability(1.5)
    AcousticAdapter(ARRAY, RATE, Flat()).set_no_source_probability(0.5)  # type: ignore[arg-type]
