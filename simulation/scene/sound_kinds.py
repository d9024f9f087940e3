"""Kinds of sounds that are no engine and no tyre: what they are, how loud, where to, how high.

Levels are A-weighted, in dB re 20 uPa at 1 m in front in the free field, over the eighths of a second that
are within 10 dB of the loudest: a horn is as loud as its blast, whatever its pauses.
"""

from dataclasses import dataclass

from worldstate.ground.checks import one_of

from .kinds import FLAT, Octaves

PLACE, VEHICLE, MICROPHONES = "a place", "a vehicle", "the microphones"


@dataclass(frozen=True, slots=True)
class SoundKind:
    """One kind of sound."""

    name: str
    label: str
    level_db: float  # See the head of this file; of rain and gusts at a microphone
    height_m: float = 1.0
    # Level straight behind against straight ahead, per octave; in between the mean over (1 + cos angle) / 2.
    back_db: Octaves = FLAT
    origin: str = PLACE  # What it belongs to: PLACE, VEHICLE or MICROPHONES
    faces: float = 1.0  # Of a signal of a vehicle: 1 from the front forwards, -1 from the rear backwards


# A talker's head shades high frequencies, after the polar patterns of Chu and Warnock, "Detailed directivity
# of sound fields around human talkers", NRC Canada, 2002; rounded by us.
HEAD_DB: Octaves = (-1.0, -2.0, -3.0, -5.0, -6.0, -9.0, -14.0, -18.0)
# A piston of 0.1 m in a box turns directional where its circumference is a wavelength, some 500 Hz (assumed).
BOX_DB: Octaves = (0.0, -1.0, -3.0, -7.0, -11.0, -15.0, -18.0, -20.0)
# A horn mouth on a car's front or roof, and the car's body behind it (assumed).
MOUTH_DB: Octaves = (-2.0, -3.0, -6.0, -9.0, -12.0, -15.0, -17.0, -18.0)

_TABLE = (
    # ISO 9921:2003: raised effort is 66 dB(A) at 1 m with its pauses, normal 60, loud 72.
    SoundKind("voice", "one talker, raised effort", 68.3, 1.5, HEAD_DB),
    # Hard heels on paving; assumed.
    SoundKind("steps", "one person walking", 58.0, 0.05),
    # Assumed: some 65 dB(A) at 100 m.
    SoundKind("bell", "church bell", 105.0, 25.0),
    # Makers' declarations of hand-held tools lie at 90 to 100 dB(A) at the operator; assumed.
    SoundKind("saw", "circular saw", 95.0, 1.0),
    SoundKind("drill", "hammer drill in masonry", 93.0, 1.2),
    # Assumed: a loudspeaker in an open window.
    SoundKind("music", "music with beat and bass", 80.0, 2.5, BOX_DB),
    # Assumed: small songbirds at full song.
    SoundKind("birds", "songbirds", 82.0, 5.0),
    # Assumed: an air conditioner's fan, a transformer.
    SoundKind("tone", "steady tones of a machine", 85.0, 2.0, BOX_DB),
    # 110 dB(A) at 3.5 m in front, DIN 14610, is 121 at 1 m.
    SoundKind("siren", "two-tone siren", 121.0, 1.8, MOUTH_DB, VEHICLE),
    # Assumed as loud as the two-tone one.
    SoundKind("wail", "wailing siren", 121.0, 1.8, MOUTH_DB, VEHICLE),
    # 93 dB(A) at 7 m in front of the vehicle, the least that UN Regulation No. 28 asks, is 110 at 1 m.
    SoundKind("horn", "horn of a car", 110.0, 0.5, MOUTH_DB, VEHICLE),
    # 97 dB(A) at 1.2 m, class C of SAE J994, is 98.6 at 1 m.
    SoundKind("beeper", "reversing beeper", 98.6, 0.8, MOUTH_DB, VEHICLE, faces=-1.0),
    # Assumed.
    SoundKind("bicycle-bell", "bell of a bicycle", 80.0, 1.0, origin=VEHICLE),
    # Drops on the roof round each microphone and the rain of the whole street; assumed: moderate rain.
    SoundKind("rain", "rain on roof and street", 58.0, origin=MICROPHONES),
    # In the octave of 100 Hz, unweighted, as `ego_sound` has it at 10 m/s behind a windscreen and 6 dB more.
    SoundKind("gusts", "gusts at one to three microphones", 82.0, origin=MICROPHONES),
)
SOUNDS = {kind.name: kind for kind in _TABLE}
SIGNALS = tuple(kind.name for kind in _TABLE if kind.origin == VEHICLE)


def sound_kind(name: str) -> SoundKind:
    """Return a kind of sound by its name."""
    return SOUNDS[one_of("sound", name, SOUNDS)]
