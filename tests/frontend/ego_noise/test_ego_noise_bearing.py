"""Ego-noise where people listen: the filter's belief opens and shuts the gate, end to end."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
import soundfile

from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.datasets.feature_table import read_features
from worldstate.adapters.files.acoustic_domain import check_tables
from worldstate.adapters.files.array_file import write_array_xml
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.listener import listen_steps, measure_steps
from worldstate.adapters.source import ListenSettings, Source, open_source
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.ego_noise.ego_noise import EgoNoiseSettings
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import AcousticFrame
from worldstate.ground.errors import InvalidArgumentError, OutOfDomainError
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


def test_a_model_trained_without_ego_noise_hears_none_and_no_other_model_does(
    recording: Path, tmp_path: Path
) -> None:
    """What `extract-features --ego-noise` writes, a model names and `run --ego-noise` hears."""
    few, short = MicrophoneArray(ARRAY.positions_m[::4], "few"), tmp_path / "short.wav"
    soundfile.write(short, soundfile.read(recording, frames=3 * RATE)[0][:, ::4], RATE, subtype="FLOAT")
    rows = {"1": "left,D1,1,short.wav,2.5", "2": "none,D2,2,short.wav,"}
    labels = tmp_path / "labels.csv"
    header = "ID,Class,Environment,Recording ID,File,End"
    labels.write_text("\n".join([header, *(f"{name},{row}" for name, row in rows.items())]))
    write_array_xml(tmp_path / "few.xml", few)
    tables = []
    for name, options in (("raw", []), ("cleaned", ["--ego-noise"])):
        words = [str(tmp_path), "--labels", str(labels), "--array", str(tmp_path / "few.xml")]
        assert main(["model", "features", *words, "--out", str(tmp_path / f"{name}.csv"), *options]) == 0
        tables.append(read_features(tmp_path / f"{name}.csv"))
    raw, cleaned = tables
    with pytest.raises(OutOfDomainError, match="ego-noise whitened"):
        check_tables(raw.domain, cleaned.domain)
    # White noise has no direction: of the loudest one's lead over the median little is left.
    lead = [np.log(table.features[0].reshape(2, 30)).max(axis=1) for table in tables]
    assert (lead[1] < lead[0] - 0.5).all()

    shipped = read_model()
    models = [replace(shipped, signature=replace(shipped.signature, domain=one.domain)) for one in tables]
    heard = open_source(short, array=few, model=models[1], settings=ListenSettings(ego_noise=True))
    # There the first second is not learned, and what was learned is not quite the same.
    apart = [np.abs(frames(heard, 1.0)[-1].feature - table.features[1]).mean() for table in tables]
    assert apart[1] < 0.3 * apart[0]
    for model, asked in ((models[1], False), (models[0], EgoNoiseSettings(feature=True))):
        source = open_source(short, array=few, model=model, settings=ListenSettings(ego_noise=asked))
        with pytest.raises(OutOfDomainError, match="ego-noise whitened"):
            next(measure_steps(source))


def test_settings_of_one_s_own(recording: Path) -> None:
    chosen = EgoNoiseSettings(feature=True)
    for given, expected in ((False, None), (True, EgoNoiseSettings()), (chosen, chosen)):
        assert ListenSettings(ego_noise=given).front_end(ARRAY, 48_000.0).ego_noise == expected


def test_the_command_line_passes_it_on(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[Source] = []

    def listened(source: Source, **_: object) -> None:
        heard.append(source)
        raise InvalidArgumentError("enough")

    monkeypatch.setattr("worldstate.cli.common.listening.listen_with_progress", listened)
    for options in ([], ["--ego-noise"]):
        main(["run", str(recording), "--uncalibrated", *options])
    assert [source.settings.ego_noise for source in heard] == [False, True]


def test_a_belief_out_of_range_is_refused_and_without_ego_noise_ignored() -> None:
    class Flat:
        def evidence(self, feature: object, /) -> None: ...

    settings = FrontEndSettings(nfft=256, ego_noise=EgoNoiseSettings())
    learning = AcousticAdapter(ARRAY, RATE, Flat(), front_end_settings=settings)  # type: ignore[arg-type]
    with pytest.raises(InvalidArgumentError, match="none_probability"):
        learning.set_no_source_probability(1.5)
    AcousticAdapter(ARRAY, RATE, Flat()).set_no_source_probability(0.5)  # type: ignore[arg-type]
