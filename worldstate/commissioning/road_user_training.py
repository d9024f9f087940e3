"""Train the classifier of road users: each kind passes alone, at one microphone.

Town streams contain hardly any trams or motorcycles, and two vehicles at once have no class. Instead, every
kind comes out of the left arm of every junction, over the ambience of the place.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from worldstate.abduction.road_users import UNKNOWN, RoadUserModel
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.spectra.sound_character import BANDS, EDGES_HZ, HOPS_A_SECOND, MEASURES
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.parallel import in_processes
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.ground.values import significant
from worldstate.simulation.scene.kinds import vehicle_kind
from worldstate.simulation.sound.receiver import standing_m
from worldstate.simulation.stream.arrivals import VehicleEvent
from worldstate.simulation.stream.manoeuvres import LEFT, draw_driver, emerges
from worldstate.simulation.stream.settings import StreamSettings
from worldstate.simulation.stream.truth import visible_s

from .guard_training import SoundRows, characters, event_and_ambience, fit_softmax, loudness
from .heard_stream import junction_named

# Classes of road users, by kind of the simulator.
CLASS_OF = {
    **{"light": "car", "electric": "car", "medium": "van", "heavy": "truck", "tram": "tram"},
    **{"motorcycle": "motorcycle", "bicycle": "bicycle", "scooter": "bicycle"},
}
# Shares of the kinds, assumed like those of simulated traffic, with some motorcycles and trams added.
_SHARES = {
    **{"light": 0.70, "electric": 0.06, "medium": 0.07, "heavy": 0.03, "tram": 0.01},
    **{"motorcycle": 0.02, "bicycle": 0.09, "scooter": 0.02},
}
CLASSES = (*dict.fromkeys(CLASS_OF.values()), UNKNOWN)
# Range of hops in the figures, seconds from line of sight; earlier hops are learned, too.
FIRST_S, LAST_S = -3.0, 1.5
_DRIVEN_S, _LEAD_S = 7.0, 3.0  # Rendered time before line of sight, and duration of the ambience before it
# Ratio to the ambience, 250 to 2600 Hz, over one second. At 0 dB a seventh of the hops of cars are labelled
# unknown, although their class is found as well.
_AUDIBLE_DB = -6.0
# Chosen on real clips of cars and trams, which are used for nothing else: their log-loss is 0.28 at this
# strength and 0.40 at 0.003. For passes at junctions it is 0.59 and 0.55 with one renderer, 0.86 and 0.91
# with the other.
STRENGTH = 0.001
# If the response of a recorder rises or falls over the band, the band levels change linearly over octaves.
# Every row is used for training unchanged and with two tilts of this size from end to end. A tilt of 6 dB
# then changes no mean probability of a kind by more than 0.05 (0.14 without).
_TILT_DB = 21.0
_OCTAVES = 0.5 * np.log2(np.multiply(EDGES_HZ[:-1], EDGES_HZ[1:]))
_NATS_OF_TILT = 0.1 * np.log(10.0) * (_OCTAVES - _OCTAVES.mean()) / np.log2(EDGES_HZ[-1] / EDGES_HZ[0])
CHOSEN_FOR_ROAD_USERS = f"strength {STRENGTH} of road users chosen on 82 passes of cars and trams"
_FOLDS = 8
_FIGURES = 5  # Significant figures of coefficients


@dataclass(frozen=True, slots=True, eq=False)
class RoadUserRows(SoundRows):
    """Hops of vehicles that pass alone."""

    audible: BoolArray  # shape (n,)
    counts: BoolArray  # shape (n,): Whether the vehicle is near line of sight

    @property
    def classes(self) -> IndexArray:
        """Number of the class of every hop, shape (n,)."""
        names = np.where(self.audible, [CLASS_OF[kind] for kind in self.kinds.tolist()], UNKNOWN)
        return np.array([CLASSES.index(name) for name in names.tolist()])

    @property
    def weights(self) -> FloatArray:
        """Weight of every hop, shape (n,), with sum 1: kinds are as frequent as in a town."""
        near = {kind: int((self.counts & (self.kinds == kind)).sum()) for kind in _SHARES}
        shares = np.array([_SHARES[kind] / max(near[kind], 1) for kind in self.kinds.tolist()])
        return np.asarray(shares * self.counts)


def road_user_rows(
    array: MicrophoneArray,
    sites: Sequence[str],
    sample_rate_hz: float,
    rng: np.random.Generator,
    *,
    passes: int = 1,
    jobs: int = 1,
    on_pass: Callable[[], None] = lambda: None,
) -> RoadUserRows:
    """Render passes of every kind at every site, at the middle microphone."""
    position = standing_m(array)[array.middle]
    seeds = rng.integers(2**63, size=(passes, len(sites)))
    plan = [(name, int(seed)) for row in seeds for name, seed in zip(sites, row, strict=True)]
    rows = []
    for heard in in_processes(partial(_rows_at, position, sample_rate_hz), plan, jobs):
        rows.append(heard)
        on_pass()
    return RoadUserRows.joined(rows)


def _rows_at(position_m: FloatArray, sample_rate_hz: float, drawn: tuple[str, int]) -> RoadUserRows:
    name, seed = drawn
    settings = StreamSettings(junction_named(name), minutes=1.0, sample_rate_hz=sample_rate_hz)
    drawn_by_kind = zip(CLASS_OF, np.random.default_rng(seed).spawn(len(CLASS_OF)), strict=True)
    return RoadUserRows.joined([_pass(settings, kind, position_m, rng) for kind, rng in drawn_by_kind])


def _pass(
    settings: StreamSettings, kind: str, position_m: FloatArray, rng: np.random.Generator
) -> RoadUserRows:
    site, preset, rate = settings.site, settings.preset, settings.sample_rate_hz
    driver = draw_driver(site, vehicle_kind(kind), preset, rng, LEFT)
    driver = replace(driver, reach_m=min(driver.reach_m, _DRIVEN_S * driver.speed_mps))
    event = VehicleEvent(LEFT, emerges(driver, rng), 0.0)
    seen_s = visible_s(event, site)
    if seen_s is None:
        raise InvalidArgumentError(f"{site.name}: expected a junction where vehicles come into view")
    sound, ambience = event_and_ambience(settings, event, position_m, rng, _LEAD_S)
    measures, usable = characters(sound + ambience, rate)
    ratio = (_over_a_second(loudness(part, rate)) for part in (sound, ambience))
    audible = np.divide(*ratio) >= 10.0 ** (_AUDIBLE_DB / 10.0)
    time_s = (np.arange(len(usable)) + 1) / HOPS_A_SECOND - _LEAD_S - seen_s
    named = np.full(len(measures), kind), np.full(len(measures), site.name)
    rows = RoadUserRows(measures, *named, audible[usable], time_s[usable] >= FIRST_S)
    return rows.select(time_s[usable] <= LAST_S)


def _over_a_second(power: FloatArray) -> FloatArray:
    return np.convolve(power, np.ones(HOPS_A_SECOND))[: len(power)]


def with_close(rows: RoadUserRows, close: SoundRows) -> RoadUserRows:
    """Return the rows with those of close vehicles, which have no effect on the frequencies of kinds."""
    vehicles = close.select(np.isin(close.kinds, list(CLASS_OF)))
    number = len(vehicles.kinds)
    heard = (vehicles.measures, vehicles.kinds, vehicles.sites, np.ones(number, np.bool_))
    return RoadUserRows.joined([rows, RoadUserRows(*heard, np.zeros(number, np.bool_))])


def fit_road_users(rows: RoadUserRows) -> RoadUserModel:
    """Fit a softmax to classes of equal weight, then set their frequencies to those of a town."""
    tilts = [replace(rows, measures=tilted(rows.measures, tilt_db)) for tilt_db in (-_TILT_DB, _TILT_DB)]
    rows = RoadUserRows.joined([rows, *tilts])
    classes = rows.classes
    equal = 1.0 / np.bincount(classes, minlength=len(CLASSES))[classes]
    weights = equal * len(classes) / equal.sum()
    slopes, biases = fit_softmax(rows.measures, classes, equal, weights, STRENGTH)
    shares = town_shares(rows)
    rounded = (significant(one, _FIGURES) for one in (slopes, biases + np.log(shares), shares))
    return RoadUserModel((*MEASURES, *BANDS), CLASSES, *rounded)


def tilted(measures: FloatArray, tilt_db: float) -> FloatArray:
    """Return the measures for a recorder whose response rises by `tilt_db` over all bands."""
    bands = measures[:, len(MEASURES) :] + tilt_db * _NATS_OF_TILT
    return np.column_stack([measures[:, : len(MEASURES)], bands])


def town_shares(rows: RoadUserRows) -> FloatArray:
    """Return the frequency of every class near line of sight in a town, shape (classes,)."""
    return np.asarray(np.bincount(rows.classes, rows.weights, len(CLASSES)) / rows.weights.sum())


def cross_validated(rows: RoadUserRows) -> FloatArray:
    """Return the probabilities of every hop from a model not trained on its site, shape (n, classes)."""
    sites, found = np.unique(rows.sites), np.zeros((len(rows.sites), len(CLASSES)))
    for fold in range(min(_FOLDS, len(sites))):
        here = np.isin(rows.sites, sites[fold::_FOLDS])
        found[here] = fit_road_users(rows.select(~here)).probabilities(rows.measures[here])
    return found
