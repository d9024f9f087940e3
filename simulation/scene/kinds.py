"""Kinds of road users as parameters: length, height, and sound power at each speed.

Light, medium and heavy vehicles and motorcycles are categories 1 to 4 of CNOSSOS-EU. Electric cars, bicycles
and trams are not in it: their values are assumed and compared with published pass-by levels (see each kind).
"""

from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground.checks import one_of

Octaves = tuple[float, float, float, float, float, float, float, float]

SILENT_DB = -60.0
NO_OCTAVES: Octaves = (SILENT_DB,) * 8
FLAT: Octaves = (0.0,) * 8


@dataclass(frozen=True, slots=True)
class VehicleKind:
    """One kind of road user.

    References
    ----------
    Directive (EU) 2015/996 as amended by (EU) 2021/1226, table F-1.
    """

    name: str  # Our name, and the class of the detector
    label: str
    length_m: float  # Length of the body
    width_m: float
    height_m: float
    axles_m: tuple[float, ...]  # Axles behind the front; the engine is at the first
    # Sound power level of the tyres per octave, L = A + B log10(v / 70 km/h), dB re 1 pW.
    rolling_a_db: Octaves
    rolling_b_db: Octaves
    propulsion_a_db: Octaves  # Sound power level of the engine, L = A + B (v - 70) / 70
    propulsion_b_db: Octaves
    # Above this speed the propulsion part fades out within 5 km/h: the warning sound of electric cars
    propulsion_until_kmh: float = np.inf
    engine_m: float = 0.3  # Height of the engine as a source; tyres are at `TYRE_M`
    ridden_mps: tuple[float, float] | None = None  # Range of speeds, if it differs from that of the street
    harmonic_share: float = 0.5  # Share of the engine's power in multiples of its firing frequency
    turns_hz: tuple[float, float] | None = None  # Crank speed of an engine whose single pulses are audible


TYRE_M = 0.05

LIGHT = VehicleKind(
    "light",
    "car",
    4.3,
    1.8,
    1.5,
    (0.9, 3.5),
    (83.1, 89.2, 87.7, 93.1, 100.1, 96.7, 86.8, 76.2),
    (30.0, 41.5, 38.9, 25.7, 32.5, 37.2, 39.0, 40.0),
    (97.9, 92.5, 90.7, 87.2, 84.7, 88.0, 84.4, 77.1),
    (-1.3, 7.2, 7.7, 8.0, 8.0, 8.0, 8.0, 8.0),
)
MEDIUM = VehicleKind(
    "medium",
    "truck",
    7.0,
    2.2,
    2.9,
    (1.1, 5.3),
    (88.7, 93.2, 95.7, 100.9, 101.7, 95.1, 87.8, 83.6),
    (30.0, 35.8, 32.6, 23.8, 30.1, 36.2, 38.3, 40.1),
    (105.5, 100.2, 100.5, 98.7, 101.0, 97.8, 91.2, 85.0),
    (-1.9, 4.7, 6.4, 6.5, 6.5, 6.5, 6.5, 6.5),
    engine_m=0.5,
)
HEAVY = VehicleKind(
    "heavy",
    "truck",
    10.0,
    2.5,
    3.5,
    (1.4, 7.5),
    (91.7, 96.2, 98.2, 104.9, 105.1, 98.5, 91.1, 85.6),
    (30.0, 33.5, 31.3, 25.4, 31.8, 37.1, 38.6, 40.6),
    (108.8, 104.2, 103.5, 102.9, 102.6, 98.5, 93.8, 87.5),
    (0.0, 3.0, 4.6, 5.0, 5.0, 5.0, 5.0, 5.0),
    engine_m=0.75,
)
# Tyres of a light vehicle. In place of the engine, the warning sound of UN Regulation No. 138 up to 20 km/h:
# at least 50 dB(A) at 2 m at 10 km/h and 56 dB(A) at 20 km/h, about 70 dB sound power, from 250 Hz to 2 kHz.
ELECTRIC = replace(
    LIGHT,
    name="electric",
    propulsion_a_db=(SILENT_DB, SILENT_DB, 95.0, 97.0, 97.0, 91.0, SILENT_DB, SILENT_DB),
    propulsion_b_db=(0.0, 0.0, 42.0, 42.0, 42.0, 42.0, 0.0, 0.0),
    propulsion_until_kmh=20.0,
)
# About 50 dB(A) at 7.5 m at 20 km/h, 20 dB below a light vehicle's tyres.
BICYCLE = replace(
    LIGHT,
    name="bicycle",
    label="bicycle",
    length_m=1.8,
    width_m=0.6,
    height_m=1.8,
    axles_m=(0.35, 1.45),
    ridden_mps=(3.5, 6.0),
    rolling_a_db=(63.1, 69.2, 67.7, 73.1, 80.1, 76.7, 70.8, 64.2),
    propulsion_a_db=NO_OCTAVES,
    propulsion_b_db=FLAT,
    harmonic_share=0.0,
)
# Electric kick scooter: small hard tyres and a hub motor, 4 dB above a bicycle (assumed). It emits noise
# only, because the model's engine harmonics follow the gears of a car.
SCOOTER = replace(
    BICYCLE,
    name="scooter",
    length_m=1.2,
    height_m=1.8,
    axles_m=(0.1, 0.95),
    ridden_mps=(3.5, 5.5),  # The range ends at 20 km/h
    rolling_a_db=(66.1, 73.2, 74.7, 80.1, 84.1, 80.7, 74.8, 66.2),
    propulsion_a_db=(SILENT_DB, SILENT_DB, 56.0, 60.0, 60.0, 56.0, 52.0, SILENT_DB),
    propulsion_b_db=(0.0, 0.0, 20.0, 20.0, 20.0, 20.0, 20.0, 0.0),
    engine_m=0.1,
)
# Noise of wheels and rails at street speeds, about 72 dB(A) at 7.5 m at 30 km/h, from four bogies; traction
# noise is far below. The spectrum follows the third-octave spectra of 32 real passes: maximum at 250 Hz, 24
# dB less at 2 kHz.
TRAM = replace(
    LIGHT,
    name="tram",
    label="train",
    length_m=30.0,
    width_m=2.4,
    height_m=3.6,
    axles_m=(3.0, 11.0, 19.0, 27.0),
    rolling_a_db=(102.0, 109.0, 115.0, 111.0, 100.0, 91.0, 85.0, 79.0),
    rolling_b_db=(30.0,) * 8,
    propulsion_a_db=(85.0, 86.0, 87.0, 86.0, 84.0, 80.0, 74.0, 68.0),
    propulsion_b_db=(3.0,) * 8,
    harmonic_share=0.0,
)

# Category 4b of CNOSSOS-EU, which contains the engine alone, at 2,100 to 9,000 turns per minute.
MOTORCYCLE = replace(
    LIGHT,
    name="motorcycle",
    label="motorcycle",
    length_m=2.1,
    width_m=0.8,
    height_m=1.5,
    axles_m=(0.35, 1.75),
    rolling_a_db=NO_OCTAVES,
    rolling_b_db=FLAT,
    propulsion_a_db=(99.9, 101.9, 96.7, 94.4, 95.2, 94.7, 92.1, 88.6),
    propulsion_b_db=(3.2, 5.9, 11.9, 11.6, 11.5, 12.6, 11.1, 12.0),
    engine_m=0.4,
    turns_hz=(35.0, 150.0),
)

KINDS = {kind.name: kind for kind in (LIGHT, MEDIUM, HEAVY, ELECTRIC, BICYCLE, SCOOTER, TRAM, MOTORCYCLE)}


def vehicle_kind(name: str) -> VehicleKind:
    """Return a kind by its name."""
    return KINDS[one_of("kind", name, KINDS)]
