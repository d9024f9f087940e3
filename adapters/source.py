"""What is listened to: a recording with its array, model, camera and what was believed before."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.road_users import RoadUserModel
from worldstate.abduction.sequence.sequence_model import SequenceModel
from worldstate.abduction.sequence.sequence_reader import SequenceReader
from worldstate.abduction.sequence.street_sides import SidePatterns, StreetHearing, StreetListener
from worldstate.abduction.signature.domain_guard import DomainGuard, ModelDomain
from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.site_estimate import SiteEstimateSettings, SiteSignature
from worldstate.adapters.audio.open_sound import SoundInput, path_of
from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import SeveralCameras, VisionQuery
from worldstate.adapters.files.acoustic_domain import heard_with
from worldstate.adapters.files.checkpoint_file import Checkpoint
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.feature import feature_nfft
from worldstate.frontend.ego_noise.ego_noise import EgoNoiseSettings
from worldstate.frontend.settings import FrontEndSettings, default_band_hz
from worldstate.ground import InvalidArgumentError, NotUsable, in_range
from worldstate.measurement.sector import Sector
from worldstate.state import Context

from .acoustic import Grounding, Signature
from .own_parts import OtherModality

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ListenSettings:
    """How a recording is listened to; the defaults are those of `worldstate run`.

    Parameters
    ----------
    alpha : float or None
        False-positive budget that the threshold was set for; the model file says which it holds. None takes
        the first one, where sound is only measured.
    band_hz : (float, float), optional
        Band of the spatial spectrum, Hz; it follows the spacing of the microphones where not given.
    azimuth_span_deg : float
        Width of the sector ahead that is searched, whole degrees: 180, or 360 for all round.
    mask_dead : bool
        Listen without silent channels, as long as half of them are left, instead of refusing them.
    site_adaptation : bool
        Learn what the site is like while listening, where the model compares windows with their site.
    forgetting_s : float, optional
        Time constant of that, seconds; see `SiteEstimateSettings`.
    grounding : Grounding, optional
        Weighs the model's scores with bearing, approach and engine line, eq. (5); off where not given.
    ego_noise : bool or EgoNoiseSettings
        Learn the own vehicle's noise while the filter believes that nothing is there, and hear past it:
        spatial spectrum, bearing and prominence. The signature hears what it was trained with: a model that
        was trained on windows without that noise hears such.
    boxes : DetectionFilter
        Which of the camera's boxes count: classes, score, height.
    uncalibrated : bool
        Go on where the model was made for another array, rate or band; then no cue states an alpha and the
        snapshots say that they are not calibrated.

    Raises
    ------
    InvalidArgumentError
        If the span is not a whole number of degrees from 2 to 360.

    Examples
    --------
    >>> ListenSettings(azimuth_span_deg=360).alpha
    0.02
    """

    alpha: float | None = 0.02
    band_hz: tuple[float, float] | None = None
    azimuth_span_deg: float = 180.0
    mask_dead: bool = False
    site_adaptation: bool = True
    forgetting_s: float | None = None
    grounding: Grounding | None = None
    ego_noise: bool | EgoNoiseSettings = False
    boxes: DetectionFilter = field(default_factory=DetectionFilter)
    uncalibrated: bool = False

    def __post_init__(self) -> None:
        if in_range("azimuth_span_deg", self.azimuth_span_deg, 2.0, 360.0) % 1.0:
            got = self.azimuth_span_deg
            raise InvalidArgumentError(f"azimuth_span_deg: expected whole degrees, got {got}")
        self.site()  # refuses a wrong time constant

    def front_end(self, array: MicrophoneArray, sample_rate_hz: float) -> FrontEndSettings:
        """Return the front-end's settings for an array and a sample rate."""
        half_deg = 0.5 * self.azimuth_span_deg
        return FrontEndSettings(
            nfft=feature_nfft(sample_rate_hz),
            azimuth_span_deg=(-half_deg, half_deg),
            srp_band_hz=self.band_hz or default_band_hz(array, sample_rate_hz),
            ego_noise=EgoNoiseSettings() if self.ego_noise is True else self.ego_noise or None,
        )

    def site(self) -> SiteEstimateSettings | None:
        """Return how the site is learned, None for not at all."""
        if not self.site_adaptation:
            return None
        given = () if self.forgetting_s is None else (self.forgetting_s,)
        return SiteEstimateSettings(*given)


@dataclass(frozen=True, slots=True)
class Source:
    """A recording with all that is needed to listen to it.

    Parameters
    ----------
    sound : Path, tuple of Path, SoundStream or Audio
        Multichannel sound file, a file a microphone, a stream such as a pipe, or an open recording such as
        `LiveSound`.
    array : MicrophoneArray
        One microphone a channel, in the order of the channels.
    detections : DetectionLog or None
        What the camera reported, on the clock of the sound; None counts as not asked.
    model : Signature
        From features to likelihoods.
    policy : CueingPolicy
        Threshold, sustained rule and risk map.
    context : Context
        Rates, occluders, ego motion.
    settings : ListenSettings
        How it is listened to.
    t0_s : float or None
        Line-of-sight entry where the recording knows it, seconds from its start.
    hazard_free : bool
        Whether the recording is labelled as one without a vehicle; False where nothing is known.
    camera : PinholeCamera
        That took the images.
    miss_rates : MissRates or None
        Measured for the camera's detector; the defaults of `VisionQuery` without.
    degradation : float or callable
        d of the camera, or a function from the stamp to it.
    before : Checkpoint or None
        Belief, site and street to go on from; hops up to its time are heard, which fills the windows, and not
        measured.
    start_ns : int
        Time of the first sample on the clock of that belief.
    guard : DomainGuard or None
        Tells sounds that the model was not made for.
    road_users : RoadUserModel or None
        Tells which kind of road user is heard.
    sequence : SequenceModel, NotUsable or None
        Reads when a vehicle comes into view; or why the model's cannot be used here.
    sides : SidePatterns or None
        What either arm of a known street sounds like; not read where `before` holds what was heard of it.
    co_evidence : SeveralCameras or None
        Asked in place of the detections of one camera.
    others : tuple of callables
        What other sensors measured, odometry too, each returning it in the order of stamps on the clock of
        the sound.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from worldstate.adapters import open_source
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     source = open_source(path)
    >>> source.detections is None, source.t0_s is None
    (True, True)
    """

    sound: SoundInput
    array: MicrophoneArray
    detections: DetectionLog | None
    model: Signature
    policy: CueingPolicy
    context: Context
    settings: ListenSettings = field(default_factory=ListenSettings)
    t0_s: float | None = None
    hazard_free: bool = False
    camera: PinholeCamera = field(default_factory=PinholeCamera)
    miss_rates: MissRates | None = None
    degradation: float | Callable[[int], float] = 0.0
    before: Checkpoint | None = None
    start_ns: int = 0
    guard: DomainGuard | None = None
    road_users: RoadUserModel | None = None
    sequence: SequenceModel | NotUsable | None = None
    sides: SidePatterns | None = None
    co_evidence: SeveralCameras | None = None
    others: tuple[OtherModality, ...] = ()

    def world(self) -> WorldFilter:
        """Return the belief before the first hop."""
        if self.before is None:
            return WorldFilter(context=self.context, policy=self.policy)
        return replace(self.before.world, policy=self.policy)

    @property
    def audio_path(self) -> Path:
        """The sound file; of several the first, and a pipe's name."""
        return path_of(self.sound)

    def signature(self) -> Signature:
        """Return the model as it is at the start of the recording; one that learns its site learns anew."""
        site = self.settings.site()
        if site is None or not isinstance(self.model, EnsembleModel):
            return self.model
        return SiteSignature(self.model, site, estimate=None if self.before is None else self.before.site)

    def reader(self) -> SequenceReader | NotUsable | None:
        """Return the sequence model as it is at the start of the recording, or why it cannot be used."""
        known, before = self.sequence, self.before
        if not isinstance(known, SequenceModel):
            return known
        history, street = (None, None) if before is None else (before.history, before.street)
        listener = street_listener(getattr(self.model, "domain", None), self.sides, street)
        return SequenceReader(known, history, listener)

    def camera_channel(self) -> VisionQuery:
        """Return the camera's detections as the channel that is asked for co-evidence."""
        rates = self.miss_rates
        return VisionQuery(
            self.camera,
            self.detections,
            rates.table if rates is not None else None,
            self.degradation,
            self.settings.boxes,
            line_of_sight=unoccluded_sector(self.context),
            clutter=rates.clutter_rate if rates is not None else None,
        )


def unoccluded_sector(context: Context) -> Sector:
    """Return the directions that no occluder of the context hides.

    Examples
    --------
    >>> sector = unoccluded_sector(Context())
    >>> bool(sector.touches(0.5)), bool(sector.touches(0.7))
    (True, False)
    """
    return Sector.in_sight(occluder.edge_azimuth_rad for occluder in context.occluders)


def street_listener(
    domain: ModelDomain | None, known: SidePatterns | None, before: StreetHearing | None
) -> StreetListener | None:
    """Return what learns a street while it is heard: from what was heard before, else from what is known.

    What another array heard is left out, and a warning says so.
    """
    if domain is None:
        return None
    heard_by = heard_with(domain)
    given = known if before is None else before.known
    if given is not None and given.heard_by not in ("", heard_by):
        _LOG.warning("the street's sides were heard by another array (%s) and are left out", given.heard_by)
        before = known = None
    return StreetListener(before or StreetHearing(replace(known or SidePatterns(), heard_by=heard_by)))
