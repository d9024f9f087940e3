"""What is listened to: a recording with its array, model, camera, and what was believed before."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self, TypedDict, TypeVar

import numpy as np

from worldstate.abduction.co_evidence import Sector
from worldstate.abduction.cueing.cueing_policy import CueingPolicy, uncalibrated_policy
from worldstate.abduction.road_users import DomainGuard, RoadUserModel
from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_model import SequenceModel
from worldstate.abduction.sequence.sequence_reader import SequenceReader
from worldstate.abduction.sequence.street_sides import SidePatterns, StreetHearing, StreetListener
from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.published_signature import ModelDomain
from worldstate.abduction.signature.site_estimate import SiteEstimateSettings, SiteSignature
from worldstate.adapters.audio.sound_file import SoundInput, SoundStream, as_sound, path_of
from worldstate.adapters.camera.camera_channel import seen_in, video_degradation
from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog, Detector, read_any_detections
from worldstate.adapters.camera.miss_rates import MissRates, load_miss_rates
from worldstate.adapters.camera.pinhole import PinholeCamera, read_camera
from worldstate.adapters.camera.video import VIDEO_NAME, open_video
from worldstate.adapters.camera.vision_query import SeveralCameras, VisionQuery, within_images
from worldstate.adapters.datasets.ovad import FRAME_RATE_HZ, Recording, choose_array
from worldstate.adapters.files.acoustic_domain import UNFIT, array_of, check_array, heard_with, states_budget
from worldstate.adapters.files.array_file import read_array
from worldstate.adapters.files.array_match import TRAIN
from worldstate.adapters.files.checkpoint_file import Checkpoint, read_checkpoint
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.adapters.files.odometry_file import OdometryLog
from worldstate.belief.settings import FilterSettings
from worldstate.belief.street_model import StreetModel
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.frontend.settings import FrontEndSettings, default_band_hz, default_span_deg
from worldstate.ground import (
    InputFileError,
    InvalidArgumentError,
    NotUsable,
    OutOfDomainError,
    in_range,
    nanoseconds,
)
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import seconds
from worldstate.state import Context

from .acoustic import Grounding, Signature
from .own_parts import OtherModality

_LOG = logging.getLogger(__name__)
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ListenSettings:
    """How a recording is listened to; the defaults are those of `worldstate run`.

    Parameters
    ----------
    budget : float, optional
        False alarms an hour, by the curve in the model file; the file's own budget if neither is given.
    alpha : float, optional
        Share of hazard-free time in alarm, by the same curve; of a model without a sequence the budget of
        one of its policies, 0.02 or its first one if none is given.
    band_hz : (float, float), optional
        Band of the spatial spectrum, Hz; it follows the spacing of the microphones where not given.
    azimuth_span_deg : float, optional
        Width of the sector ahead that is searched, whole degrees. Where not given, 180 if a sequence model
        reads the bearing, else by the array: all round if it tells front from back.
    mask_dead : bool
        Listen without silent channels, as long as half of them are left, instead of refusing them.
    site_adaptation : bool
        Learn what the site is like while listening, where the model compares windows with their site.
    forgetting_s : float, optional
        Time constant of that, seconds; see `SiteEstimateSettings`.
    grounding : Grounding, optional
        Weighs the model's scores with bearing, approach and engine line, eq. (5); off where not given.
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
    >>> ListenSettings(azimuth_span_deg=360, budget=12.0).budget
    12.0
    """

    budget: float | None = None
    alpha: float | None = None
    band_hz: tuple[float, float] | None = None
    azimuth_span_deg: float | None = None
    mask_dead: bool = False
    site_adaptation: bool = True
    forgetting_s: float | None = None
    grounding: Grounding | None = None
    boxes: DetectionFilter = field(default_factory=DetectionFilter)
    uncalibrated: bool = False

    def __post_init__(self) -> None:
        span_deg = self.azimuth_span_deg
        if span_deg is not None and in_range("azimuth_span_deg", span_deg, 2.0, 360.0) % 1.0:
            raise InvalidArgumentError(f"azimuth_span_deg: expected whole degrees, got {span_deg}")
        self.site()  # refuses a wrong time constant

    def front_end(self, array: MicrophoneArray, sample_rate_hz: float) -> FrontEndSettings:
        """Return the front-end's settings for an array and a sample rate."""
        half_deg = 0.5 * (self.azimuth_span_deg or default_span_deg(array, sample_rate_hz))
        return FrontEndSettings.heard_at(
            sample_rate_hz,
            azimuth_span_deg=(-half_deg, half_deg),
            srp_band_hz=self.band_hz or default_band_hz(array, sample_rate_hz),
        )

    def site(self) -> SiteEstimateSettings | None:
        """Return how the site is learned, None for not at all."""
        given = {} if self.forgetting_s is None else {"forgetting_s": self.forgetting_s}
        return SiteEstimateSettings(**given) if self.site_adaptation else None


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
    model : Signature or None
        From features to likelihoods; None if no model was made for the array.
    policy : CueingPolicy
        Threshold and risk map.
    context : Context
        Rates, occluders, ego motion.
    settings : ListenSettings
        How it is listened to.
    t0_s : float or None
        Line-of-sight entry where the recording knows it, seconds on the clock of the states.
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
    street : StreetModel or None
        Numbers of the belief; those that ship if the model file holds none.
    sides : SidePatterns or None
        What either arm of a known street sounds like; not read where `before` holds what was heard of it.
    co_evidence : SeveralCameras or None
        Asked in place of the detections of one camera.
    others : tuple of callables
        What other sensors measured, odometry too, each returning it in the order of stamps on the clock of
        the sound.
    kinds : mapping of str to float, or None
        Of each kind of road user, the share that the exam of the model detected; None if its sequence model
        is not used.

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
    model: Signature | None
    policy: CueingPolicy
    context: Context
    settings: ListenSettings = field(default_factory=ListenSettings)
    t0_s: float | None = None
    hazard_free: bool = False
    camera: PinholeCamera = field(default_factory=PinholeCamera.ovad)
    miss_rates: MissRates | None = None
    degradation: float | Callable[[int], float] = 0.0
    before: Checkpoint | None = None
    start_ns: int = 0
    guard: DomainGuard | None = None
    road_users: RoadUserModel | None = None
    sequence: SequenceModel | NotUsable | None = None
    street: StreetModel | None = None
    sides: SidePatterns | None = None
    co_evidence: SeveralCameras | None = None
    others: tuple[OtherModality, ...] = ()
    kinds: Mapping[str, float] | None = None

    def world(self) -> WorldFilter:
        """Return the belief before the first hop."""
        if self.before is None:
            settings = FilterSettings(street=self.street or StreetModel())
            return WorldFilter(self.context, self.policy, settings, no_model=self.no_model)
        return replace(self.before.world, policy=self.policy, no_model=self.no_model)

    @property
    def no_model(self) -> NotUsable | None:
        """Why no model reads the sound; None if one does."""
        if self.model is not None:
            return None
        alike = ", which hears front as back" if self.array.ambiguity in ("cone", "front-back") else ""
        return NotUsable(f"no model was made for this array of {self.array.n_microphones} microphones{alike}")

    @property
    def audio_path(self) -> Path:
        """The sound file; of several the first, and a pipe's name."""
        return path_of(self.sound)

    def read_by_model(self) -> Self:
        """Return the source itself.

        Raises
        ------
        OutOfDomainError
            If no model reads the sound.
        """
        if self.no_model is not None:
            raise OutOfDomainError(f"{self.array.name}: {self.no_model.reason}. {TRAIN}")
        return self

    def signature(self) -> Signature | None:
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
        rates, seen, boxes = self.miss_rates, self.detections, self.settings.boxes
        beta, clutter = (None, None) if rates is None else (rates.table, rates.clutter_rate)
        in_sight = unoccluded_sector(self.context)
        return VisionQuery(self.camera, seen, beta, self.degradation, boxes, in_sight, clutter)


def unoccluded_sector(context: Context) -> Sector:
    """Return the directions that no occluder of the context hides.

    Examples
    --------
    >>> sector = unoccluded_sector(Context())
    >>> bool(sector.touches(0.5)), bool(sector.touches(0.7))
    (True, False)
    """
    edges_rad = [occluder.edge_azimuth_rad for occluder in context.occluders]
    return Sector.in_sight([one for one in edges_rad if one < 0.0], [one for one in edges_rad if one > 0.0])


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


class _Parts(TypedDict, total=False):
    budget: float | None
    alpha: float | None
    camera: Path | str | PinholeCamera | None
    miss_rates: Path | str | MissRates | None
    model: Path | str | Model | None
    context: Context | None
    settings: ListenSettings | None


class SourceParts(_Parts, total=False):
    """What `open_source` takes of a recording beside its sound: files, or the objects that they hold."""

    array: Path | str | MicrophoneArray | None
    detections: Path | str | DetectionLog | None
    detector: Detector | None


class ListenerParts(_Parts, total=False):
    """What `open_source` takes where sound is pushed."""

    sides: SidePatterns | None
    resume: Path | str | Checkpoint | None
    moving_ego: bool


class CorpusParts(_Parts, total=False):
    """What `open_source` takes of all recordings of a corpus alike."""

    array: Path | str | MicrophoneArray | None
    sides: SidePatterns | None


def open_source(
    path: SoundInput | str | Sequence[str],
    *,
    array: Path | str | MicrophoneArray | None = None,
    detections: Path | str | DetectionLog | None = None,
    detector: Detector | None = None,
    camera: Path | str | PinholeCamera | None = None,
    miss_rates: Path | str | MissRates | None = None,
    model: Path | str | Model | None = None,
    context: Context | None = None,
    sides: SidePatterns | None = None,
    resume: Path | str | Checkpoint | None = None,
    start_s: float = 0.0,
    ego: OdometryLog | None = None,
    moving_ego: bool = False,
    others: Sequence[OtherModality] = (),
    budget: float | None = None,
    alpha: float | None = None,
    settings: ListenSettings | None = None,
) -> Source:
    """Find everything that belongs to a sound file or to a recording folder.

    Parameters
    ----------
    path : path, sequence of paths, SoundStream or Audio
        Multichannel sound file, a recording folder in the OVAD layout, a file a microphone in their order,
        a stream (raw samples from a pipe, the sound of a bag), or an open recording.
    array : path or MicrophoneArray, optional
        Acoular XML, CSV or JSON as `read_array` reads them; that of the data set where not given, OVAD's
        where it names none; the model's own for a sound file of as many channels.
    detections : path or DetectionLog, optional
        Camera detections per frame, in any form that `read_any_detections` knows; those of the recording
        folder where not given.
    detector : Detector, optional
        Looks at the video of the recording folder, in place of `detections`.
    camera : path or PinholeCamera, optional
        What took the images, as `read_camera` reads it; OVAD's camera with OVAD's array.
    miss_rates : path or MissRates, optional
        What `worldstate model detector` wrote. Where it holds the camera's scale of health and the recording
        folder has a video, the degradation is read from that.
    model : path or Model, optional
        Model; where not given, of the two that ship that for a standing or for a moving ego, as the data set
        or the context says.
    context : Context, optional
        Rates, occluders and ego motion; defaults where not given.
    sides : SidePatterns, optional
        What either arm of this street sounds like, `LearnedStreet.patterns`; with site adaptation it is
        learned on, or from nothing, from vehicles in view. What another array heard is left out, and a
        warning says so.
    resume : path or Checkpoint, optional
        Belief and site to go on from. Hops up to its time are heard, which fills the windows, and not
        measured: the same recording again goes on where the other run ended.
    start_s : float
        Time of the first sample on the clock of that belief, for a recording that follows another; a stream
        with a clock of its own brings it.
    ego : OdometryLog, optional
        How the ego vehicle moves, in place of the one speed of the context.
    moving_ego : bool
        Whether the ego vehicle will be told to move, as by a running odometry: chooses the model.
    others : sequence of callables, optional
        What other sensors measured: functions that return `Measurement` and `PositionScan` in their order.
    budget, alpha : float, optional
        How many false alarms are allowed, in place of those of `settings`.
    settings : ListenSettings, optional
        How it is listened to: budget, band, azimuths, site adaptation, boxes.

    Returns
    -------
    Source
        For `listen_steps`.

    Raises
    ------
    InputFileError
        If a file is missing or damaged; the message names it.
    InvalidArgumentError
        If the model holds no threshold for the budget, or budget and alpha are given, or detections and a
        detector, or either without the camera that took the images, where the array is not OVAD's.
    OutOfDomainError
        If the array is not that of the data set, or not the model's.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     source = open_source(path, alpha=0.02)
    >>> len(source.array.positions_m), source.sequence.alarm.asked_alpha
    (56, 0.02)
    """
    settings, context = settings or ListenSettings(), context or Context()
    if (budget, alpha) != (None, None):
        settings = replace(settings, budget=budget, alpha=alpha)
    sound = as_sound(path)
    recording = Recording.open(sound) if isinstance(sound, Path) and sound.is_dir() else None
    told = moving_ego or (ego is not None and ego.moves)
    moves = bool(told or (recording and recording.moving_ego) or context.ego_speed_mps)
    given = _read(array, read_array)
    usual = model if isinstance(model, Model) else read_model(model, moving_ego=moves, array=given)
    heard_by = _array_of(sound, usual, given, settings)
    known = usual if model is not None or settings.uncalibrated else _shipped_for(heard_by, moves)
    sequence, policy = _alarm_of(known, settings, moves)
    if known is not None and (settings.uncalibrated or not states_budget(known, heard_by, moves)):
        policy = replace(policy, alpha=0.0)
    if isinstance(sequence, SequenceModel) and settings.azimuth_span_deg is None:
        settings = replace(settings, azimuth_span_deg=_READ_SPAN_DEG)
    if camera is None and (detections, detector) != (None, None):
        check_mounting(heard_by)
    if not set(SIDES) & set(context.directions):
        named = ", ".join(context.directions)
        raise InvalidArgumentError(f"context.arms: expected left or right, as the model names, got {named}")
    first_ns = sound.start_ns if isinstance(sound, SoundStream) else 0
    start_ns = nanoseconds(in_range("start_s", start_s, 0.0, 1e10)) or first_ns
    t0_s = None if recording is None else recording.t0_s
    shares = {} if known is None else {one.kind: one.detected for one in known.provenance.kinds}
    source = Source(
        sound=sound if recording is None else recording.audio_path,
        array=heard_by,
        detections=None,
        model=None if known is None else known.signature,
        policy=policy,
        context=context,
        settings=settings,
        t0_s=None if t0_s is None else t0_s + seconds(start_ns),
        hazard_free=recording is not None and recording.label == "none",
        camera=_read(camera, read_camera) or PinholeCamera.ovad(),
        miss_rates=_read(miss_rates, load_miss_rates),
        before=_read(resume, read_checkpoint),
        start_ns=start_ns,
        guard=None if known is None else known.guard,
        road_users=None if known is None else known.road_users,
        sequence=sequence,
        street=StreetModel() if known is None else known.street,
        sides=sides,
        others=tuple(others) if ego is None else (*others, ego.told.__iter__),
        kinds=shares if isinstance(sequence, SequenceModel) else None,
    )
    return _with_camera(source, recording, detections, detector)


_ALPHA = 0.02  # The paper's budget, of a model without a sequence
# Half the plane ahead, in which the bearings were that sequence models have learned from.
_READ_SPAN_DEG = 180.0
_SOUND_ONLY = f"Bearings and tracks of sound are stated, and no side, class or risk. {TRAIN}"
# Of a pipe or of microphones, whose end is not known, seconds.
_ONE_DAY_S = 86_400.0
# Stamps closer together are in another unit, and so are those of what begins with the sound and lasts so many
# times as long.
_SHORTEST_STEP_S, _MOST_LONGER = 5e-4, 100.0
# Share of the stamps, and of the sound, that has the other beside it: below it a line warns. Of images at a
# rate that is assumed or stated, and of all stamps: a camera may stop earlier.
_TOGETHER = 0.97, 0.9, 0.6
# From UTC to TAI, from UTC to GPS, and between these, seconds: clocks that were set by different sources.
_TIME_SCALES_S, _SAME_S = (37.0, 18.0, 19.0), 1.0
# Of cameras that take fewer images than assumed; images go on after the sound by less than a second.
_SLOW_RATES_HZ, _SAME_LENGTH, _LONGER_S = (1.0, 2.0, 2.5, 5.0, 7.5), 0.03, 1.0


def check_clocks(source: Source, length_s: float | None) -> None:
    """Refuse stamps on another clock than the sound, and images at another rate than was assumed.

    What was recorded beside it would else be passed over, or searched at other times than it was taken. The
    length of the sound is None where it is not known.
    """
    begins_s = seconds(source.start_ns)
    ends_s = begins_s + (_ONE_DAY_S if length_s is None else length_s)
    held = [(source.detections, source.camera)]
    if source.co_evidence is not None:
        held = [(one.detections, one.camera) for one in source.co_evidence.cameras.values()]
    for log, offset_s in [(log, camera.stamp_offset_s) for log, camera in held if log]:
        if log.assumed and length_s is not None:
            _check_rate(log, seconds(int(log.stamps_ns[-1])) - begins_s - offset_s, length_s)
        together_s = offset_s + begins_s - seconds(int(log.stamps_ns[0]))
        way_on = f'"stamp_offset_s": {together_s:.1f} of its camera would make both begin together'
        least = _TOGETHER[0 if log.assumed else 1 if log.counted_hz else 2]
        _check_stamps(log.source, log.stamps_ns / 1e9, (begins_s, ends_s), way_on, least)
    for other in source.others:
        if not (told := [*other()]):
            _LOG.warning("%s: no measurement in it", getattr(other, "keywords", {}).get("name", "a sensor"))
            continue
        more_s = begins_s - seconds(told[0].stamp_ns)
        way_on = f"{more_s:.1f} s more would make both begin together; --start (start_s) moves the sound"
        times_s = np.array([seconds(one.stamp_ns) for one in told])
        _check_stamps(told[0].source, times_s, (begins_s, ends_s), way_on, _TOGETHER[-1])


def _check_stamps(
    name: str, times_s: FloatArray, sound_s: tuple[float, float], way_on: str, least: float
) -> None:
    """Refuse times none of which lies within the sound, in other units, or off by a time scale; see `least`.

    A line warns if less than that share of them, or of the sound, has the others beside it.
    """
    (begins_s, ends_s), first_s, last_s = sound_s, float(times_s[0]), float(times_s[-1])
    length_s, span_s, within = (
        ends_s - begins_s,
        last_s - first_s,
        (begins_s <= times_s) & (times_s <= ends_s),
    )
    step_s, off_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 1.0, first_s - begins_s
    slow = abs(off_s) < _SAME_S < step_s and span_s > _MOST_LONGER * length_s
    if step_s < _SHORTEST_STEP_S or slow:
        problem = f"expected stamps in nanoseconds, times in seconds, got {len(times_s)} in {span_s:.3g} s"
        raise InputFileError(name, f"{problem} beside {length_s:.1f} s of sound: in another unit?")
    scale = any(max(abs(abs(off_s) - one), abs(span_s - length_s)) < _SAME_S for one in _TIME_SCALES_S)
    if scale or not within.any():
        expected = f"expected stamps on the clock of the sound, {begins_s:.1f} to {ends_s:.1f} s"
        raise InputFileError(name, f"{expected}, got {first_s:.1f} to {last_s:.1f} s: {way_on}")
    covered_s = min(last_s + step_s, ends_s) - max(first_s, begins_s)
    if length_s < _ONE_DAY_S and min(within.mean(), covered_s / length_s) < least:
        told = "%s: %d of %d stamps lie within the sound, of which they cover %.1f of %.1f s"
        _LOG.warning(told, name, within.sum(), len(times_s), covered_s, length_s)


def _check_rate(log: DetectionLog, last_s: float, length_s: float) -> None:
    """Refuse images of a rate that was not stated, where they go on after the sound or fit another rate."""
    assumed_hz = log.counted_hz or 0.0
    images = round(last_s * assumed_hz) + 1
    rate_hz = images / length_s
    # Where the last one has a box, those after it may not be listed.
    slow = not len(log.frames[-1]) and any(abs(rate_hz / one - 1.0) < _SAME_LENGTH for one in _SLOW_RATES_HZ)
    if slow or images / assumed_hz > length_s * (1.0 + _SAME_LENGTH) + _LONGER_S:
        got = f"got number {images - 1} in {length_s:.1f} s of sound, as at {rate_hz:.3g} a second"
        way_on = "state their rate (--image-rate, image_rate_hz), or count them from the first sample"
        raise InputFileError(log.source, f"expected {assumed_hz:g} images a second, {got}: {way_on}")


def check_mounting(array: MicrophoneArray) -> None:
    """Refuse images of a camera that was not described: the one of OVAD is known, beside OVAD's array."""
    positions_m = ovad_array().positions_m
    if array.n_microphones != len(positions_m) or not np.allclose(array.positions_m, positions_m, atol=1e-3):
        problem = "expected the camera that took the images: its lens, and where it stands beside the array"
        raise InvalidArgumentError(f"camera: {problem} (--camera JSON)")


def _read(given: Path | str | T | None, reader: Callable[[Path | str], T]) -> T | None:
    """Return what a file holds, and what is no path as it is."""
    return reader(given) if isinstance(given, Path | str) else given


def _array_of(
    sound: SoundInput, model: Model, array: MicrophoneArray | None, settings: ListenSettings
) -> MicrophoneArray:
    """Return the array of the sound: the one that is given, that of its data set, or that of the model."""
    if array is None and isinstance(sound, SoundStream):
        raise InputFileError(sound.name, "expected --array: such a stream names no microphones")
    assumed = None if model.domain is None else array_of(model.domain)
    return choose_array(path_of(sound), array, assumed=assumed, trust_given=settings.uncalibrated)


def _shipped_for(array: MicrophoneArray, moves: bool) -> Model | None:
    """Return the model that ships for an array; None if there is none, and a warning says so."""
    model = read_model(moving_ego=moves, array=array)
    try:
        return model if model.domain is None or len(check_array(model.domain, array, _SOUND_ONLY)) else None
    except OutOfDomainError as error:
        _LOG.warning("%s", error)
        return None


def _alarm_of(
    model: Model | None, settings: ListenSettings, moves: bool
) -> tuple[SequenceModel | NotUsable | None, CueingPolicy]:
    """Return the sequence model with the alarm that was asked for, and the policy, by alpha without one."""
    if model is None:
        asked = {"budget": settings.budget, "alpha": settings.alpha, "grounding": settings.grounding}
        for name in (name for name, value in asked.items() if value is not None):
            raise InvalidArgumentError(f"{name}: expected a model for the array. {TRAIN}")
        return None, uncalibrated_policy()
    sequence, policies = _sequence_of(model, moves, settings.uncalibrated), model.policies
    usual = next((one for one in policies.policies if one.alpha == _ALPHA), policies.policies[0])
    if isinstance(sequence, SequenceModel):
        return sequence.asking(settings.budget, settings.alpha), usual
    if settings.budget is not None:
        raise InvalidArgumentError(f"budget: expected a model with a sequence ({sequence.reason})")
    return sequence, usual if settings.alpha is None else policies.for_alpha(settings.alpha)


def _sequence_of(model: Model, moving_ego: bool, uncalibrated: bool) -> SequenceModel | NotUsable:
    """Return the sequence model of a file where it was made for what is heard, else why it is not used."""
    if model.sequence is None:
        return NotUsable("the model states no times: `worldstate model make` makes one that does")
    if uncalibrated:
        return NotUsable("uncalibrated: times are stated of the array that the model was made for")
    if not model.provenance.fit_for_use:
        return NotUsable(UNFIT)
    if model.domain is None:
        return NotUsable("the model names no array that it was made for")
    motion = "moving" if moving_ego else "standing"
    if model.domain.ego_motion not in (motion, "any"):
        return NotUsable(f"the model was made for a {model.domain.ego_motion} ego, this one is {motion}")
    return model.sequence


def _with_camera(
    source: Source,
    recording: Recording | None,
    detections: Path | str | DetectionLog | None,
    detector: Detector | None,
) -> Source:
    """Return the source with what the camera reported, on the clock of the sound, and how well it sees."""
    video = None if recording is None else recording.path / VIDEO_NAME
    camera, rates, degradation = source.camera, source.miss_rates, source.degradation
    if detector is None:
        given = recording.detections_path if detections is None and recording is not None else detections
        size_px = camera.width_px, camera.height_px
        rate_hz = FRAME_RATE_HZ if detections is None else None
        log = _read(given, lambda path: read_any_detections(path, rate_hz, size_px))
        if video is not None and rates is not None and rates.health is not None and video.is_file():
            degradation = video_degradation(open_video(video), rates, source.start_ns)
    elif detections is not None or video is None:
        raise InvalidArgumentError("detector: expected a recording folder with a video and no detections")
    else:
        log, degradation = seen_in(open_video(video), detector, rates, source.start_ns)
    if log is not None:
        log = within_images(camera, log.on_clock(source.start_ns, camera.stamp_offset_s))
    return replace(source, detections=log, degradation=degradation)
