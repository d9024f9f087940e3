"""Arguments that the front-end refuses, one row for each."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from worldstate.adapters.listener import Listener
from worldstate.adapters.source import ListenSettings
from worldstate.frontend import FrontEnd, FrontEndSettings, GivenSpectra, MicrophoneArray, ovad_array
from worldstate.frontend.approach.engine_line import track_fundamental
from worldstate.frontend.approach.looming import looming
from worldstate.frontend.approach.tone import estimate_tone
from worldstate.frontend.direction.feature import published_feature
from worldstate.frontend.direction.gcc_phat import gcc_delays
from worldstate.frontend.direction.music import count_sources, covariance, music_spectrum, signal_subspace
from worldstate.frontend.given_spectra import SpectrumFrontEnd
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.recordings.channel_report import rate_from_duration

SQUARE = MicrophoneArray([[0.1, 0.1, 0], [0.1, -0.1, 0], [-0.1, -0.1, 0], [-0.1, 0.1, 0]])
PAIR = MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]])
SEVEN = MicrophoneArray(ovad_array().positions_m[::8])
TIMES_S = np.arange(-0.95, 0.0, 0.1)
BAND_HZ = np.arange(300.0, 1800.0, 50.0)
AHEAD_RAD = np.radians(np.linspace(-90.0, 90.0, 180))
QUIET, NAN = np.full((3, 180), 0.2), np.nan


def front_end(rate_hz, **settings):
    return lambda: FrontEnd(SQUARE, rate_hz, FrontEndSettings(**settings))


def line(low_hz, high_hz):
    return lambda: FrontEnd(PAIR, 8_000, FrontEndSettings(tone_band_hz=(low_hz, high_hz)))


def block(samples):
    return lambda: FrontEnd(SQUARE, 16_000).process(samples)


def delays(**changes):
    good = {"spectra": np.ones((3, 30, 2)), "frequencies_hz": BAND_HZ, "max_delay_s": 1e-3}
    return lambda: gcc_delays(**(good | changes))


def given(values=QUIET, azimuths=AHEAD_RAD):
    return lambda: GivenSpectra(values, azimuths, SEVEN)


def beside_spectra(samples):
    settings = FrontEndSettings(level_band_hz=(50.0, 2700.0))
    return lambda: SpectrumFrontEnd(given()(), 48_000, settings).process(samples)


REFUSALS: dict[str, tuple[Callable[[], object], str]] = {
    "band above half the recorded rate": (
        lambda: FrontEnd(SQUARE, 8_000, ListenSettings(band_hz=(300.0, 5000.0)).front_end(SQUARE, 8_000)),
        "less than half the sample rate of 8000",
    ),
    "one microphone": (lambda: MicrophoneArray([[0, 0, 0]]), "2 to 1024"),
    "positions in a plane": (lambda: MicrophoneArray([[0, 0], [1, 1]]), r"shape \(any, 3\)"),
    "position that is no number": (lambda: MicrophoneArray([[0, 0, 0], [0, 0, NAN]]), "finite"),
    "positions as text": (lambda: MicrophoneArray([["0", "0", "0"], ["0", "1", "0"]]), "numbers"),
    "positions of different length": (lambda: MicrophoneArray([[0, 0, 0], [0, 1]]), "numbers"),
    "two pairs of microphones at one place": (
        lambda: MicrophoneArray([[0, 1, 0], [0, 2, 0], [0, 2, 0], [0, 1, 0]]),
        "microphones 1 and 4 0 m apart",
    ),
    "sample rate below the band": (front_end(3_500, nfft=256), "half the sample rate"),
    "window that is too short for the band": (front_end(4_000), "nfft"),
    "sample rate of zero": (front_end(0), "sample_rate_hz"),
    "odd window": (front_end(48_000, nfft=511), "nfft"),
    "azimuths of half degrees": (front_end(48_000, azimuth_span_deg=(-10.0, 10.5)), "whole degrees"),
    "azimuths that fall": (front_end(48_000, azimuth_span_deg=(10.0, 5.0)), "azimuth_span_deg"),
    "band that falls": (front_end(48_000, srp_band_hz=(1800.0, 300.0)), "srp_band_hz"),
    "engine line below the filter": (line(1.0, 400.0), "tone_band_hz"),
    "engine line above half the sample rate": (line(20.0, 4_000.0), "tone_band_hz"),
    "engine line in too narrow a band": (line(10.0, 20.0), "tone_band_hz: expected a filter"),
    "engine line in a band that falls": (line(400.0, 20.0), "tone_band_hz"),
    "block of three channels for four": (block(np.zeros((10, 3))), "block"),
    "block of one dimension": (block(np.zeros(10)), "block"),
    "block of text": (block("sound"), "block"),
    "block of None": (block([[None] * 4]), "block"),
    "infinite samples": (block(np.full((2, 4), np.inf)), "block"),
    "samples beyond single precision": (block(np.full((2, 4), 1e300)), "block"),
    "transform of an odd window": (lambda: StreamingStft(2, 511, range(1, 9)), "nfft"),
    "transform of bins above half the rate": (lambda: StreamingStft(2, 512, range(1, 258)), "bins"),
    "transform of no bins": (lambda: StreamingStft(2, 512, range(5, 5)), "bins"),
    "transform of every second bin": (lambda: StreamingStft(2, 512, range(1, 9, 2)), "bins"),
    "feature of six channels for seven": (
        lambda: published_feature(np.zeros((48_000, 6)), SEVEN, 47_998),
        "window",
    ),
    "feature of a short window": (
        lambda: published_feature(np.zeros((511, 7)), SEVEN, 47_998),
        "512 samples",
    ),
    "feature of no number": (lambda: published_feature(np.full((600, 7), NAN), SEVEN, 47_998), "finite"),
    "looming of three hops": (lambda: looming(TIMES_S[:3], np.zeros(3), 0.1), "times"),
    "looming with times that fall": (lambda: looming(TIMES_S[::-1], np.zeros(10), 0.1), "times"),
    "looming without an energy for each time": (lambda: looming(TIMES_S, np.zeros(9), 0.1), "energy"),
    "looming of no number": (lambda: looming(TIMES_S, np.full(10, NAN), 0.1), "energy"),
    "looming without scatter": (lambda: looming(TIMES_S, np.zeros(10), 0.0), "floor"),
    "fundamental of ten samples": (lambda: track_fundamental(np.zeros(10), 4000.0), "samples"),
    "fundamental of no number": (lambda: track_fundamental(np.full(8000, NAN), 4000.0), "samples"),
    "fundamental at a low sample rate": (lambda: track_fundamental(np.zeros(8000), 2000.0), "sample_rate"),
    "tone of seven samples": (lambda: estimate_tone(np.ones(7), 1000.0), "samples"),
    "tone of silence": (lambda: estimate_tone(np.zeros(64), 1000.0), "samples"),
    "tone of no number": (lambda: estimate_tone(np.full(64, NAN), 1000.0), "samples"),
    "tone of eight channels": (lambda: estimate_tone(np.ones((8, 8)), 1000.0), "samples"),
    "tone at a sample rate of zero": (lambda: estimate_tone(np.ones(64), 0.0), "sample_rate"),
    "delay beyond the resolution": (delays(max_delay_s=0.011), "max_delay_s"),
    "negative delay": (delays(max_delay_s=-1e-3), "max_delay_s"),
    "delay with frequencies that fall": (delays(frequencies_hz=BAND_HZ[::-1]), "frequencies_hz"),
    "delay of no number": (delays(spectra=np.full((3, 30, 2), NAN)), "spectra"),
    "covariance of no frames": (lambda: covariance(np.zeros((0, 3, 4))), "spectra"),
    "covariance of no number": (lambda: covariance(np.full((2, 3, 4), NAN)), "spectra"),
    "covariance of text": (lambda: covariance([["a"]]), "spectra"),
    "more sources than frames": (lambda: signal_subspace(np.ones((2, 3, 4)), 3), "sources"),
    "as many sources as microphones": (lambda: signal_subspace(np.ones((9, 3, 4)), 4), "sources"),
    "steering of another array": (
        lambda: music_spectrum(signal_subspace(np.ones((2, 3, 4)), 1), np.ones((3, 5, 7))),
        "steering",
    ),
    "sources in one frame": (lambda: count_sources([1.0, 2.0, 3.0], 1), "eigenvalues"),
    "negative eigenvalue": (lambda: count_sources([1.0, -2.0], 9), "eigenvalues"),
    "spectra with azimuths that fall": (given(azimuths=AHEAD_RAD[::-1]), "ascending"),
    "spectra of half the view": (given(azimuths=AHEAD_RAD / 2.0), "-90 to 90"),
    "spectra without a value for each azimuth": (given(np.full((3, 90), 0.2)), "values"),
    "spectra of zeros": (given(np.zeros((3, 180))), "pair sums"),
    "spectra above one": (given(np.full((3, 180), 1.2)), "pair sums"),
    "spectra of no number": (given(np.full((3, 180), NAN)), "values"),
    "two channels beside spectra": (beside_spectra(np.zeros((10, 2))), "block"),
    "no number beside spectra": (beside_spectra(np.full((10, 1), NAN)), "block"),
    "gap beside spectra": (
        lambda: Listener(ovad_array(), 48_000, spectra=given()()).skip(10**9),
        "uninterrupted sound",
    ),
    "spectra at 16 kHz": (
        lambda: SpectrumFrontEnd(given()(), 16_000, FrontEndSettings.heard_at(16_000)),
        "48 kHz",
    ),
    "recording of no duration": (partial(rate_from_duration, 48_000, 0.0, 0.1, 48_000.0), "duration_s"),
}


@pytest.mark.parametrize(("call", "words"), REFUSALS.values(), ids=REFUSALS)
def test_refuses(call, words):
    with pytest.raises(InvalidArgumentError, match=words):
        call()
