"""What the front-end says every hop."""

from dataclasses import dataclass

from worldstate.frontend.approach.looming import Looming
from worldstate.frontend.approach.tone_stage import ToneReading
from worldstate.frontend.array.geometry import Ambiguity
from worldstate.frontend.direction.music_stage import MusicReading
from worldstate.frontend.direction.peaks import Peak
from worldstate.frontend.health.channel_health import ArrayHealth
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable

_NOT_WATCHED = NotUsable("microphones were not watched")
TONE_IS_OFF = NotUsable("the tone is off: see FrontEndSettings.tone_band_hz")


@dataclass(frozen=True, slots=True, eq=False)
class AcousticFrame:
    """Everything the front-end reads from the sound up to one instant.

    Parameters
    ----------
    stamp_ns : int
        End of the window, nanoseconds on the stream's clock.
    sample_index : int
        Number of samples up to there.
    azimuths_rad : ndarray, shape (A,)
        Grid of `srp`, ascending from right (negative) to left.
    srp : ndarray of float64, shape (A,)
        SRP-PHAT of the decision window, 0..1; where elevations are searched, the highest over them.
    elevations_rad : ndarray, shape (E,)
        Rows of `srp_map`, ascending.
    srp_map : ndarray of float64, shape (E, A)
        SRP-PHAT of the decision window over elevation and azimuth.
    bearing_rad, bearing_std_rad : float
        Strongest peak over the last `bearing_hops` hops.
    prominence : float
        Peak-to-median ratio of the spectrum that the bearing was read from.
    elevation_rad : float
        Elevation of that peak.
    peaks : tuple of Peak
        All peaks of that spectrum, highest first, at most `max_peaks`; the first is the bearing.
    ambiguity : str
        What the array cannot tell apart: see `MicrophoneArray.ambiguity`.
    mirror_bearing_rad : float or NotUsable
        The azimuth that sounds the same as the bearing to this array.
    music : MusicReading or NotUsable
        MUSIC on the decision window; not usable when it is off.
    band_log_energy : ndarray of float64, shape (16,)
        ln mean square of the last hop per band.
    looming : Looming or NotUsable
        Approach rate at the end of the window.
    feature : ndarray of float64, shape (60,)
        The published feature of the decision window: two halves x thirty azimuths, from left to right.
    bearing_age_s : float
        How long before `stamp_ns` the middle of the bearing's interval was, seconds.
    health : ArrayHealth or NotUsable
        What is wrong with the microphones, and which were left out; not usable in frames made by hand.
    tone : ToneReading or NotUsable
        Engine line over the last `tone_hops` hops; not usable when it is off, or none stands out.

    Examples
    --------
    >>> import numpy as np
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> from worldstate.frontend.stream import FrontEnd
    >>> array = MicrophoneArray([[0, 0.2, 0], [0, 0.0, 0], [0, -0.3, 0]])
    >>> sound = np.random.default_rng(0).standard_normal((8000, 3))
    >>> frame = FrontEnd(array, 8000).process(sound)[0]
    >>> frame.stamp_ns, frame.srp.shape, frame.feature.shape
    (1000000000, (181,), (60,))
    """

    stamp_ns: int
    sample_index: int
    azimuths_rad: FloatArray
    srp: FloatArray
    elevations_rad: FloatArray
    srp_map: FloatArray
    bearing_rad: float
    bearing_std_rad: float
    prominence: float
    elevation_rad: float
    peaks: tuple[Peak, ...]
    ambiguity: Ambiguity
    mirror_bearing_rad: float | NotUsable
    music: MusicReading | NotUsable
    band_log_energy: FloatArray
    looming: Looming | NotUsable
    feature: FloatArray
    bearing_age_s: float = 0.0
    health: ArrayHealth | NotUsable = _NOT_WATCHED
    tone: ToneReading | NotUsable = TONE_IS_OFF
