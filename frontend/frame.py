"""The result of the front-end for one hop."""

from dataclasses import dataclass

from worldstate.frontend.approach.looming import Looming
from worldstate.frontend.approach.tone import ToneReading
from worldstate.frontend.direction.bearing import Peak
from worldstate.frontend.health.channel_health import ArrayHealth
from worldstate.ground import FloatArray, NotUsable

_NOT_MONITORED = NotUsable("microphones were not monitored")
CHARACTER_IS_OFF = NotUsable("the character is off: see FrontEndSettings.character")
TONE_IS_OFF = NotUsable("the tone is off: see FrontEndSettings.tone_band_hz")


@dataclass(frozen=True, slots=True, eq=False)
class AcousticFrame:
    r"""Results of the front-end at the end of one hop.

    .. math:: \hat\theta = \arg\max_\theta P(\theta), \qquad \rho = P(\hat\theta) / \mathrm{median}_\theta P

    with the bearing, its prominence rho, and the SRP-PHAT spectrum P of the last two hops.

    Parameters
    ----------
    stamp_ns : int
        End of the window, nanoseconds on the stream's clock.
    sample_index : int
        Number of samples up to there.
    azimuths_rad : ndarray, shape (A,)
        Grid of `srp`, radians, ascending from right (negative) to left.
    srp : ndarray of float64, shape (A,)
        SRP-PHAT of the decision window, 0..1; the maximum over the elevations.
    bearing_rad, bearing_std_rad : float
        Azimuth of the highest peak over the last two hops and its standard deviation, radians.
    prominence : float
        Peak-to-median ratio of the spectrum that the bearing was read from.
    least_prominence : float
        Ratio that noise reaches with this array; a peak not above it says nothing of any direction.
    peaks : tuple of Peak
        All peaks of that spectrum, highest first, at most four; the first is the bearing.
    band_log_energy : ndarray of float64, shape (16,)
        Natural logarithm of the mean square of the last hop per band; of the last one that could be heard.
    looming : Looming or NotUsable
        Approach rate at the end of the window.
    feature : ndarray of float64, shape (60,)
        The published feature of the decision window: two halves x thirty azimuths, from left to right.
    bearing_age_s : float
        From the middle of the interval of the bearing to `stamp_ns`, seconds.
    health : ArrayHealth or NotUsable
        Faults of the microphones and which were left out.
    tone : ToneReading or NotUsable
        Engine line over the decision window; not usable when it is off or no tone exceeds the noise.
    character : ndarray, shape (49,), or NotUsable
        What the middle microphone heard in the last two seconds, whatever its level: modulation, what bands
        have in common, tones, harmonics, which a `DomainGuard` reads; and how the level is shared between
        twelve bands, which a `RoadUserModel` reads, too.
    lost : float
        Share of the samples of the decision window that are lost: constant or repeated in all channels. STFT
        frames that hold lost samples are left out of everything here; means are over the others.
    heard : float
        Share that could be heard, of the newest hop or of the window, whichever is less; 0 where less than .4
        of the window is left. Hops of which less than .2 could be heard are left out of everything here.
    unheard : str or None
        Why the rest could not: "lost samples", "wind" or "noise far above this place's usual".
    excess_db : float
        Level of the newest hop above the quiet street, a mean over bands, decibels.

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
    bearing_rad: float
    bearing_std_rad: float
    prominence: float
    peaks: tuple[Peak, ...]
    band_log_energy: FloatArray
    looming: Looming | NotUsable
    feature: FloatArray
    least_prominence: float = 1.0
    bearing_age_s: float = 0.0
    health: ArrayHealth | NotUsable = _NOT_MONITORED
    tone: ToneReading | NotUsable = TONE_IS_OFF
    character: FloatArray | NotUsable = CHARACTER_IS_OFF
    lost: float = 0.0
    heard: float = 1.0
    excess_db: float = 0.0
    unheard: str | None = None
