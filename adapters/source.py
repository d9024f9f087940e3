"""A recording opened with its array, model, camera, place and earlier belief: input of the chain."""

import io
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, Self, TypeAlias, TypedDict, TypeVar, cast

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
from worldstate.adapters.audio.plain_samples import Encoding
from worldstate.adapters.audio.sound_file import RawPcm, SoundInput, SoundStream, as_sound, path_of
from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog, Detector, read_any_detections
from worldstate.adapters.camera.detectors import ALL_MOTION
from worldstate.adapters.camera.miss_rates import MissRates, load_miss_rates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import VIDEO_NAME, open_video, seen_in, video_degradation
from worldstate.adapters.camera.vision_query import SeveralCameras, VisionQuery, within_images
from worldstate.adapters.datasets.ovad import FRAME_RATE_HZ, Recording, choose_array
from worldstate.adapters.files.acoustic_domain import UNFIT, array_of, check_array, heard_with, states_budget
from worldstate.adapters.files.array_file import read_array
from worldstate.adapters.files.array_match import TRAIN
from worldstate.adapters.files.checkpoint_file import Checkpoint, read_checkpoint
from worldstate.adapters.files.context_file import read_context
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.adapters.files.odometry_file import OdometryLog, read_odometry
from worldstate.adapters.ros.bag_input import BagSound, is_bag, needed_array, read_beside, read_sound
from worldstate.adapters.vehicle.car_file import CameraSetup, CarSensors, read_camera_setup, read_car
from worldstate.belief.street_model import FilterSettings, StreetModel
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.frontend.settings import FrontEndSettings, default_band_hz, default_span_deg
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InputFileError, InvalidArgumentError, OutOfDomainError
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable, nanoseconds, seconds
from worldstate.state import Context

from .acoustic import Grounding, Signature
from .own_parts import MOTION, OtherModality, detector_maker, other_modality

_LOG = logging.getLogger(__name__)
NO_STREET = "the model file holds no numbers of the belief: the shipped ones are used"
RAW = "pcm:"
_TOPICS = "audio", "detections", "odometry"
_ALPHA = 0.02  # The paper's budget, for a model without a sequence
# Sequence models were trained on bearings in the half plane ahead.
_READ_SPAN_DEG = 180.0
_SOUND_ONLY = f"The states hold bearings and tracks of sound, but no side, class or risk. {TRAIN}"
# A stream and microphones have no known length; this one is assumed.
_ONE_DAY_S = 86_400.0
# Closer time stamps have another unit, and so have stamps that begin with the sound and last this many times
# longer.
_SHORTEST_STEP_S, _MOST_LONGER = 5e-4, 100.0
# Without a warning at least this share of the stamps is within the sound, and they cover at least this share
# of it: for images with an assumed rate, with a stated rate, and with stamps of their own, because a camera
# may stop earlier.
_TOGETHER = 0.97, 0.9, 0.6
# Offsets from UTC to TAI, from UTC to GPS and from GPS to TAI, between clocks that were set by different
# sources.
_TIME_SCALES_S, _SAME_S = (37.0, 18.0, 19.0), 1.0
# Usual rates of slower cameras. Images may continue after the sound for less than a second.
_SLOW_RATES_HZ, _SAME_LENGTH, _LONGER_S = (1.0, 2.0, 2.5, 5.0, 7.5), 0.03, 1.0
T = TypeVar("T")
Detections: TypeAlias = Path | str | DetectionLog


@dataclass(frozen=True, slots=True)
class ListenSettings:
    """Settings of the chain from sound to states; the defaults are those of `worldstate run`.

    Parameters
    ----------
    budget : float, optional
        Allowed false alarms per hour; the curve in the model file gives the threshold. Default: the budget
        of the model file.
    alpha : float, optional
        Allowed share of hazard-free time in alarm, in place of `budget`. For a model without a sequence it
        selects one of its policies; default 0.02, or the first policy.
    band_hz : (float, float), optional
        Band of the spatial spectrum, Hz. Default: from the spacing of the microphones.
    azimuth_span_deg : float, optional
        Width of the searched sector ahead, whole degrees. Default: 180 if a sequence model uses the bearing,
        otherwise 360 for an array without front-back ambiguity.
    site_adaptation : bool
        Learn the site during the run, if the model compares windows with their site.
    forgetting_s : float, optional
        Time constant of this learning, s; see `SiteEstimateSettings`.
    grounding : Grounding, optional
        Weights the model's scores by bearing, approach and engine line, eq. (5). Default: off.
    boxes : DetectionFilter
        Classes, least score and least height of the camera's boxes that are used.
    uncalibrated : bool
        Use the model although it was made for another array, sample rate or band. Then no cue states a
        budget, and the snapshots are marked as not calibrated.

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
    site_adaptation: bool = True
    forgetting_s: float | None = None
    grounding: Grounding | None = None
    boxes: DetectionFilter = field(default_factory=DetectionFilter)
    uncalibrated: bool = False

    def __post_init__(self) -> None:
        span_deg = self.azimuth_span_deg
        if span_deg is not None and in_range("azimuth_span_deg", span_deg, 2.0, 360.0) % 1.0:
            raise InvalidArgumentError(f"azimuth_span_deg: expected whole degrees, got {span_deg}")
        self.site()  # Raises an error for a wrong time constant

    def front_end(self, array: MicrophoneArray, sample_rate_hz: float) -> FrontEndSettings:
        """Return the front-end's settings for an array and a sample rate."""
        half_deg = 0.5 * (self.azimuth_span_deg or default_span_deg(array, sample_rate_hz))
        return FrontEndSettings.heard_at(
            sample_rate_hz,
            azimuth_span_deg=(-half_deg, half_deg),
            srp_band_hz=self.band_hz or default_band_hz(array, sample_rate_hz),
        )

    def site(self) -> SiteEstimateSettings | None:
        """Return the settings of site adaptation, None if it is off."""
        given = {} if self.forgetting_s is None else {"forgetting_s": self.forgetting_s}
        return SiteEstimateSettings(**given) if self.site_adaptation else None


@dataclass(frozen=True, slots=True)
class Source:
    """A recording with everything that the chain needs.

    Parameters
    ----------
    sound : Path, tuple of Path, SoundStream or Audio
        Multichannel sound file, one file per microphone, a stream such as a pipe, or an open recording such
        as `LiveSound`.
    array : MicrophoneArray
        One microphone per channel, in the order of the channels.
    detections : DetectionLog or None
        Detections of the camera, on the clock of the sound; None if the camera was not queried.
    model : Signature or None
        From features to likelihoods; None if there is no model for the array.
    policy : CueingPolicy
        Threshold and risk map.
    context : Context
        Rates, occluders, ego motion.
    settings : ListenSettings
        Settings of the chain.
    t0_s : float or None
        Known time of line-of-sight entry, s, on the clock of the states.
    hazard_free : bool
        Whether the recording is labelled as one without a vehicle.
    camera : PinholeCamera
        Camera that took the images.
    miss_rates : MissRates or None
        Measured miss rates of the detector; None for the defaults of `VisionQuery`.
    degradation : float or callable
        Degradation d of the camera, or a function from the time stamp to it.
    before : Checkpoint or None
        Belief, site and street to continue from. Hops up to its time fill the windows and are not measured.
    start_ns : int
        Time of the first sample on the clock of that belief.
    guard : DomainGuard or None
        Detects sounds for which the model was not made.
    road_users : RoadUserModel or None
        Classifies the road user by its sound.
    sequence : SequenceModel, NotUsable or None
        Model of the time to visible, or the reason why it cannot be used here.
    street : StreetModel or None
        Numbers of the belief; None for the shipped ones.
    sides : SidePatterns or None
        Sound of either arm of a known street; unused if `before` holds one.
    co_evidence : SeveralCameras or None
        Queried in place of the detections of one camera.
    others : tuple of callables
        Measurements of other sensors and odometry; each returns them in the order of their time stamps, on
        the clock of the sound.
    kinds : mapping of str to float, or None
        Share of each kind of road user that was detected in the model's exam; None if its sequence model is
        not used.
    crossing_m : float
        Distance ahead of the lane in which other stacks place a vehicle without a known range, m.

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
    crossing_m: float = 9.0

    def world(self) -> WorldFilter:
        """Return the belief before the first hop."""
        if self.before is None:
            settings = FilterSettings(street=self.street or StreetModel())
            return WorldFilter(self.context, self.policy, settings, no_model=self.no_model)
        return replace(self.before.world, policy=self.policy, no_model=self.no_model)

    @property
    def no_model(self) -> NotUsable | None:
        """The reason why no model is used; None if one is."""
        if self.model is not None:
            return None
        alike = ", which is front-back ambiguous" if self.array.ambiguity in ("cone", "front-back") else ""
        return NotUsable(f"no model was made for this array of {self.array.n_microphones} microphones{alike}")

    @property
    def audio_path(self) -> Path:
        """The sound file, the first of several files, or the name of a stream."""
        return path_of(self.sound)

    def read_by_model(self) -> Self:
        """Return the source itself.

        Raises
        ------
        OutOfDomainError
            If there is no model for the array.
        """
        if self.no_model is not None:
            raise OutOfDomainError(f"{self.array.name}: {self.no_model.reason}. {TRAIN}")
        return self

    def signature(self) -> Signature | None:
        """Return the model at the start of the recording, with its site estimate reset or resumed."""
        site = self.settings.site()
        if site is None or not isinstance(self.model, EnsembleModel):
            return self.model
        return SiteSignature(self.model, site, estimate=None if self.before is None else self.before.site)

    def reader(self) -> SequenceReader | NotUsable | None:
        """Return the sequence model at the start of the recording, or the reason why it cannot be used."""
        known, before = self.sequence, self.before
        if not isinstance(known, SequenceModel):
            return known
        history, street = (None, None) if before is None else (before.history, before.street)
        listener = street_listener(getattr(self.model, "domain", None), self.sides, street)
        return SequenceReader(known, history, listener)

    def camera_channel(self) -> VisionQuery:
        """Return the camera as the channel that is queried for co-evidence."""
        rates, seen, boxes = self.miss_rates, self.detections, self.settings.boxes
        beta, clutter = (None, None) if rates is None else (rates.table, rates.clutter_rate)
        in_sight = unoccluded_sector(self.context)
        return VisionQuery(self.camera, seen, beta, self.degradation, boxes, in_sight, clutter)


def unoccluded_sector(context: Context) -> Sector:
    """Return the directions that no occluder of the context covers.

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
    """Return the learner of a street, started from an earlier run or from known patterns.

    Patterns of another array are left out with a warning.
    """
    if domain is None:
        return None
    heard_by = heard_with(domain)
    given = known if before is None else before.known
    if given is not None and given.heard_by not in ("", heard_by):
        _LOG.warning("the street's sides of another array (%s) are left out", given.heard_by)
        before = known = None
    return StreetListener(before or StreetHearing(replace(known or SidePatterns(), heard_by=heard_by)))


class SourceParts(TypedDict, total=False):
    """The arguments of `open_source` that `Listener` and `hear` take as well."""

    car: Path | str | CarSensors | None
    camera: Path | str | PinholeCamera | None
    miss_rates: Path | str | MissRates | None
    model: Path | str | Model | None
    context: Path | str | Context | None
    sides: SidePatterns | None
    resume: Path | str | Checkpoint | None
    moving_ego: bool
    budget: float | None
    alpha: float | None
    uncalibrated: bool
    settings: ListenSettings | None


def open_source(
    path: SoundInput | str | Sequence[Path | str],
    array: Path | str | MicrophoneArray | None = None,
    *,
    model: Path | str | Model | None = None,
    detections: Detections | Mapping[str, Detections] | None = None,
    detector: str | Detector | None = None,
    camera: Path | str | PinholeCamera | None = None,
    miss_rates: Path | str | MissRates | None = None,
    car: Path | str | CarSensors | None = None,
    context: Path | str | Context | None = None,
    sides: SidePatterns | None = None,
    odometry: Path | str | OdometryLog | None = None,
    moving_ego: bool = False,
    others: Sequence[OtherModality] = (),
    topics: Mapping[str, str] | None = None,
    resume: Path | str | Checkpoint | None = None,
    start_s: float = 0.0,
    budget: float | None = None,
    alpha: float | None = None,
    uncalibrated: bool = False,
    settings: ListenSettings | None = None,
) -> Source:
    """Return a recording with its array, model, camera and place.

    Parameters
    ----------
    path : path, sequence of paths, SoundStream or Audio
        Multichannel sound file, recording folder in the OVAD layout, one file per microphone in the order of
        the microphones, bag of ROS 2, stream of raw samples, or open recording.
    array : path, name or MicrophoneArray, optional
        File as `read_array` reads it, or the name of a board, such as ``"xmos"``. Default: the array of the
        data set or of the bag, OVAD's for a recording folder, or the model's for a sound file with as many
        channels.
    model : path, name or Model, optional
        Default: the model of the car, or the shipped model for the array and for a standing or moving ego
        vehicle.
    detections : path or DetectionLog, optional
        Detections per image of the camera, as `read_any_detections` reads them; for several cameras of a car
        a mapping from the camera's name. Default: the files of the car or of the recording folder.
    detector : name or Detector, optional
        Detector that is run on the video of the recording folder: ``"motion"``, ``"knn"``, the path of an
        ONNX model, the name of an installed detector, or an object.
    camera : path, name or PinholeCamera, optional
        Camera that took the images: a file as `read_camera_setup` reads it, or the name of a camera of the
        car. Default: the first camera of the car, or OVAD's camera with OVAD's array.
    miss_rates : path or MissRates, optional
        Miss rates of the detector, as `worldstate model detector` writes them. If they hold a scale of the
        camera's health and the recording folder has a video, the degradation is measured on the video.
    car : path or CarSensors, optional
        Vehicle with its array, cameras, odometry, model and other sensors, as `read_car` reads it.
    context : path or Context, optional
        Rates, occluders and ego motion. Default: a usual blind junction.
    sides : SidePatterns, optional
        Sound of either arm of this street, `LearnedStreet.patterns`. With site adaptation it is learned
        further. Patterns of another array are left out with a warning.
    odometry : path or OdometryLog, optional
        Motion of the ego vehicle, in place of the constant speed of the context.
    moving_ego : bool
        Whether the ego vehicle moves although no odometry is given here; selects the model.
    others : sequence of callables, optional
        Measurements of other sensors: functions that return `Measurement` and `PositionScan` in the order of
        their time stamps.
    topics : mapping of str to str, optional
        Topics ``"audio"``, ``"detections"`` and ``"odometry"`` of a bag. Default: the only topic of each
        type. ``"TOPIC:RATE:CHANNELS:FORMAT"`` states the format of audio whose messages do not.
    resume : path or Checkpoint, optional
        Belief and learned site to continue from. Hops before its time fill the windows, but change nothing:
        a run over the same recording continues where the earlier run ended.
    start_s : float
        Time of the first sample on the clock of that belief, for a later recording.
    budget, alpha : float, optional
        Allowed false alarms per hour, or the allowed share of hazard-free time in alarm.
    uncalibrated : bool
        Use the model although it was made for another array, sample rate or band. No cue then states a
        budget.
    settings : ListenSettings, optional
        Further settings; `budget`, `alpha` and `uncalibrated` take precedence.

    Returns
    -------
    Source
        For `listen_steps` and `Listener`.

    Raises
    ------
    InputFileError
        If a file is missing or damaged; the message names it.
    InvalidArgumentError
        If the model has no threshold for the budget, if both budget and alpha are given, if detections and a
        detector are given, or if either is given without its camera for an array other than OVAD's.
    OutOfDomainError
        If the array is not that of the data set or of the model.

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
    sound, named = sound_of(path, topics or {})
    recording = Recording.open(sound) if isinstance(sound, Path) and sound.is_dir() else None
    bag = sound if isinstance(sound, BagSound) and sound is not path else None
    beside = {name: topic for name, topic in (topics or {}).items() if name != "audio"}
    boxes, ego = (None, None) if bag is None else read_beside(bag, **beside)
    place, sensors = _place(context), SourceSensors.of(array, car, camera)
    asked = sensors.boxes_in(settings_with(settings, budget, alpha, uncalibrated), detector)
    drive = _read(odometry or sensors.car.odometry, read_odometry)
    drive = ego if drive is None else drive
    driven = moving_ego or (drive is not None and drive.moves)
    moves = bool(driven or (recording and recording.moving_ego) or place.ego_speed_mps)
    given = sensors.car.array if bag is None else needed_array(bag, sensors.car.array or named)
    chosen = model or sensors.car.model
    if chosen is None and driven:
        _LOG.warning("the model of a moving ego vehicle is used, because odometry is given")
    heard_by, known = _array_and_model(sound, given, chosen, asked, moves)
    several, one = sensors.reported(detections, detector, boxes)
    if sensors.camera is None and (one, detector) != (None, None):
        check_mounting(heard_by)
    measured = [other_modality(name, file) for name, file in sensors.car.measurements.items()]
    source = Source(
        array=heard_by,
        detections=None,
        context=place,
        camera=sensors.camera or PinholeCamera.ovad(),
        miss_rates=_read(miss_rates or sensors.setup.miss_rates, load_miss_rates),
        before=_read(resume, read_checkpoint),
        sides=sides,
        others=(*others, *measured, *(() if drive is None else [drive.told.__iter__])),
        crossing_m=sensors.car.crossing_m,
        **_timed(sound, recording, start_s),
        **_read_by(known, asked, moves, heard_by),
    )
    if several:
        return with_cameras(source, sensors.car, several)
    made = detector_maker(detector, sensors.setup.labels)() if isinstance(detector, str) else detector
    return _with_camera(source, recording, one, made, sensors.setup.image_rate_hz)


def sound_of(
    path: SoundInput | str | Sequence[Path | str], topics: Mapping[str, str]
) -> tuple[SoundInput, MicrophoneArray | None]:
    """Return the sound of a recording, and the array that its bag contains."""
    if not topics.keys() <= {*_TOPICS}:
        raise InvalidArgumentError(f"topics: expected {', '.join(_TOPICS)}, got {', '.join(topics)}")
    sound = as_sound(path)
    if isinstance(sound, Path) and is_bag(sound):
        topic, _, form = topics.get("audio", "").partition(":")
        stated = raw_pcm("topics", form, io.BytesIO(), str(sound)) if form else None
        return read_sound(sound, topic or None, stated)
    if topics:
        raise InvalidArgumentError(f"topics: expected a bag; raw samples without one are {RAW}...")
    names = [str(one) for one in (sound if isinstance(sound, tuple) else [sound]) if isinstance(one, Path)]
    raw = next((name for name in names if name == "-" or name.startswith(RAW)), None)
    if raw is None:
        return sound, None
    if len(names) > 1 or raw == "-":
        raise InvalidArgumentError(f"{raw}: expected standard input alone, as {RAW}RATE:CHANNELS:FORMAT")
    return raw_pcm(raw, raw.removeprefix(RAW), sys.stdin.buffer), None


def raw_pcm(name: str, form: str, stream: BinaryIO, path: str = "/dev/stdin") -> RawPcm:
    """Return raw samples of the form RATE:CHANNELS:FORMAT; `name` is used in the error message."""
    rate, channels, encoding = [*form.split(":"), "", "s16"][:3] if form.count(":") < 3 else ("", "", "")
    if not (rate.isdecimal() and channels.isdecimal()):
        raise InvalidArgumentError(f"{name}: expected RATE:CHANNELS:FORMAT, such as 48000:8:s32")
    return RawPcm(stream, int(rate), int(channels), cast("Encoding", encoding or "s16"), path)


def settings_with(
    settings: ListenSettings | None = None,
    budget: float | None = None,
    alpha: float | None = None,
    uncalibrated: bool = False,
) -> ListenSettings:
    """Return the settings with the arguments that take precedence."""
    settings = settings or ListenSettings()
    if (budget, alpha) != (None, None):
        settings = replace(settings, budget=budget, alpha=alpha)
    return replace(settings, uncalibrated=uncalibrated or settings.uncalibrated)


def _place(context: Path | str | Context | None) -> Context:
    """Return the context; refuse one without a side of the model."""
    place = _read(context, read_context) or Context()
    if not set(SIDES) & set(place.directions):
        got = ", ".join(place.directions)
        raise InvalidArgumentError(f"context.arms: expected left or right, as in the model, got {got}")
    return place


def _timed(sound: SoundInput, recording: Recording | None, start_s: float) -> dict[str, Any]:
    """Return the fields of a source with its sound: start, and T0 and label of a data set."""
    if start_s and isinstance(sound, BagSound):
        raise InvalidArgumentError("start_s: expected none with a bag, whose messages have time stamps")
    own_ns = sound.start_ns if isinstance(sound, SoundStream) else 0
    start_ns = nanoseconds(in_range("start_s", start_s, 0.0, 1e10)) or own_ns
    if recording is None:
        return {"sound": sound, "start_ns": start_ns}
    t0_s = None if recording.t0_s is None else recording.t0_s + seconds(start_ns)
    known = {"sound": recording.audio_path, "t0_s": t0_s, "hazard_free": recording.label == "none"}
    return known | {"start_ns": start_ns}


@dataclass(frozen=True, slots=True)
class SourceSensors:
    """The car, and the camera whose detections are used; None for an undescribed camera."""

    car: CarSensors
    camera: PinholeCamera | None
    setup: CameraSetup
    chosen: bool  # Whether the caller named the camera

    @classmethod
    def of(
        cls,
        array: Path | str | MicrophoneArray | None = None,
        car: Path | str | CarSensors | None = None,
        camera: Path | str | PinholeCamera | None = None,
    ) -> Self:
        """Read the files of an array or a car, and of a camera; a name is that of a camera of the car."""
        if None not in (array, car):
            raise InvalidArgumentError("car: expected no array with it, because it has one")
        known = _read(car, read_car) or CarSensors(_read(array, read_array))
        if isinstance(camera, PinholeCamera):
            return cls(known, camera, CameraSetup(), True)
        if camera is not None and car is None:
            return cls(known, *read_camera_setup(camera), True)
        name = next(iter(known.cameras), None) if camera is None else str(camera)
        if name is None:
            return cls(known, None, CameraSetup(), False)
        return cls(known, known.camera(name), known.setups.get(name, CameraSetup()), camera is not None)

    def boxes_in(self, settings: ListenSettings, detector: str | Detector | None = None) -> ListenSettings:
        """Return the settings with the boxes that are used of the camera, or of a detector of motion."""
        boxes = ALL_MOTION if isinstance(detector, str) and detector in MOTION else self.setup.boxes
        return _with_boxes(settings, boxes)

    def reported(
        self,
        detections: Detections | Mapping[str, Detections] | None,
        detector: str | Detector | None,
        of_bag: DetectionLog | None,
    ) -> tuple[Mapping[str, Detections], Detections | None]:
        """Return the detections of several cameras by name, or those of one camera."""
        if isinstance(detections, Mapping):
            if self.chosen:
                raise InvalidArgumentError("detections: expected those of several cameras without a camera")
            return detections, None
        if detections is not None or detector is not None:
            return {}, detections
        files = {name: one.detections for name, one in self.car.setups.items() if one.detections is not None}
        if len(files) > 1 and not self.chosen:
            return files, None
        return {}, self.setup.detections or of_bag


def check_clocks(source: Source, length_s: float | None) -> None:
    """Refuse time stamps on another clock than the sound, and images at another rate than was assumed.

    Such measurements would otherwise be ignored or used at wrong times. The length of the sound is None if it
    is not known.
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
        way_on = f'"stamp_offset_s": {together_s:.1f} of its camera would align both beginnings'
        least = _TOGETHER[0 if log.assumed else 1 if log.counted_hz else 2]
        _check_stamps(log.source, log.stamps_ns / 1e9, (begins_s, ends_s), way_on, least)
    for other in source.others:
        if not (told := [*other()]):
            _LOG.warning("%s: has no measurement", getattr(other, "keywords", {}).get("name", "a sensor"))
            continue
        more_s = begins_s - seconds(told[0].stamp_ns)
        way_on = f"{more_s:.1f} s more would align both beginnings; --start (start_s) moves the sound"
        times_s = np.array([seconds(one.stamp_ns) for one in told])
        _check_stamps(told[0].source, times_s, (begins_s, ends_s), way_on, _TOGETHER[-1])


def _check_stamps(
    name: str, times_s: FloatArray, sound_s: tuple[float, float], way_on: str, least: float
) -> None:
    """Refuse times outside the sound, in another unit, or of another time scale.

    A warning is logged if less than the share `least` of them lies within the sound, or covers it.
    """
    (begins_s, ends_s), first_s, last_s = sound_s, float(times_s[0]), float(times_s[-1])
    length_s, span_s = ends_s - begins_s, last_s - first_s
    within = (begins_s <= times_s) & (times_s <= ends_s)
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
        told = "%s: %d of %d stamps lie within the sound and cover %.1f of its %.1f s"
        _LOG.warning(told, name, within.sum(), len(times_s), covered_s, length_s)


def _check_rate(log: DetectionLog, last_s: float, length_s: float) -> None:
    """Refuse images of an assumed rate that last longer than the sound or fit another rate."""
    assumed_hz = log.counted_hz or 0.0
    images = round(last_s * assumed_hz) + 1
    rate_hz = images / length_s
    # If the last listed image has a box, later images without a box may not be listed.
    slow = not len(log.frames[-1]) and any(abs(rate_hz / one - 1.0) < _SAME_LENGTH for one in _SLOW_RATES_HZ)
    if slow or images / assumed_hz > length_s * (1.0 + _SAME_LENGTH) + _LONGER_S:
        got = f"got number {images - 1} in {length_s:.1f} s of sound, as at {rate_hz:.3g} per second"
        way_on = "state their rate (image_rate_hz of the camera), or count them from the first sample"
        raise InputFileError(log.source, f"expected {assumed_hz:g} images a second, {got}: {way_on}")


def check_mounting(array: MicrophoneArray) -> None:
    """Refuse images of an undescribed camera; only OVAD's camera is known, beside OVAD's array."""
    positions_m = ovad_array().positions_m
    if array.n_microphones != len(positions_m) or not np.allclose(array.positions_m, positions_m, atol=1e-3):
        problem = "expected the camera that took the images: its lens and its position beside the array"
        raise InvalidArgumentError(f"camera: {problem} (--camera JSON)")


def _read(given: Path | str | T | None, reader: Callable[[Path | str], T]) -> T | None:
    """Return the content of a file; an object is returned unchanged."""
    return reader(given) if isinstance(given, Path | str) else given


def _array_and_model(
    sound: SoundInput,
    given: MicrophoneArray | None,
    model: Path | str | Model | None,
    settings: ListenSettings,
    moves: bool,
) -> tuple[MicrophoneArray, Model | None]:
    """Return the array of the sound and the model for it, None with a warning if no model ships for it."""
    usual = model if isinstance(model, Model) else read_model(model, moving_ego=moves, array=given)
    if given is None and isinstance(sound, SoundStream):
        raise InputFileError(sound.name, "expected an array (--array): such a stream does not name one")
    assumed = None if usual.domain is None else array_of(usual.domain)
    array = choose_array(path_of(sound), given, assumed=assumed, trust_given=settings.uncalibrated)
    if model is not None or settings.uncalibrated:
        return array, usual
    shipped = read_model(moving_ego=moves, array=array)
    try:
        fits = shipped.domain is None or len(check_array(shipped.domain, array, _SOUND_ONLY))
    except OutOfDomainError as error:
        _LOG.warning("%s", error)
        return array, None
    return array, shipped if fits else None


def _read_by(
    model: Model | None, settings: ListenSettings, moves: bool, array: MicrophoneArray
) -> dict[str, Any]:
    """Return the fields of a source that its model and the settings give; refuse settings without a model."""
    if model is None:
        asked = {"budget": settings.budget, "alpha": settings.alpha, "grounding": settings.grounding}
        for name in (name for name, value in asked.items() if value is not None):
            raise InvalidArgumentError(f"{name}: expected a model for the array. {TRAIN}")
        return {"model": None, "policy": uncalibrated_policy(), "settings": settings}
    sequence, policies = _sequence_of(model, moves, settings.uncalibrated), model.policies
    usual = next((one for one in policies.policies if one.alpha == _ALPHA), policies.policies[0])
    kinds = None
    if isinstance(sequence, SequenceModel):
        sequence = sequence.asking(settings.budget, settings.alpha)
        kinds = {one.kind: one.detected for one in model.provenance.kinds}
        settings = replace(settings, azimuth_span_deg=settings.azimuth_span_deg or _READ_SPAN_DEG)
    elif settings.budget is not None:
        raise InvalidArgumentError(f"budget: expected a model with a sequence ({sequence.reason})")
    elif settings.alpha is not None:
        usual = policies.for_alpha(settings.alpha)
    if settings.uncalibrated or not states_budget(model, array, moves):
        usual = replace(usual, alpha=0.0)
    if model.street is None:
        _LOG.warning(NO_STREET)
    parts = {name: getattr(model, name) for name in ("guard", "road_users", "street")}
    alarm = {"model": model.signature, "policy": usual, "sequence": sequence, "kinds": kinds}
    return parts | alarm | {"settings": settings}


def _sequence_of(model: Model, moving_ego: bool, uncalibrated: bool) -> SequenceModel | NotUsable:
    """Return the sequence model of a file, or the reason why it does not apply here."""
    if model.sequence is None:
        return NotUsable("the model states no times: `worldstate model make` makes one that does")
    if uncalibrated:
        return NotUsable("uncalibrated: times are valid only for the array of the model")
    if not model.provenance.fit_for_use:
        return NotUsable(UNFIT)
    if model.domain is None:
        return NotUsable("the model does not state its array")
    motion = "moving" if moving_ego else "standing"
    if model.domain.ego_motion not in (motion, "any"):
        return NotUsable(f"the model was made for a {model.domain.ego_motion} ego, this one is {motion}")
    return model.sequence


def _with_camera(
    source: Source,
    recording: Recording | None,
    detections: Detections | None,
    detector: Detector | None,
    image_rate_hz: float | None,
) -> Source:
    """Return the source with the detections of one camera, on the clock of the sound, and its degradation."""
    video = None if recording is None else recording.path / VIDEO_NAME
    rates, log = source.miss_rates, detections
    if detector is None:
        if detections is None and recording is not None:
            log, image_rate_hz = recording.detections_path, FRAME_RATE_HZ
        if video is not None and rates is not None and rates.health is not None and video.is_file():
            source = replace(source, degradation=video_degradation(open_video(video), rates, source.start_ns))
    elif detections is not None or video is None:
        raise InvalidArgumentError("detector: expected a recording folder with a video and no detections")
    else:
        log, degradation = seen_in(open_video(video), detector, rates, source.start_ns)
        source = replace(source, degradation=degradation)
    return _with_log(source, log, image_rate_hz)


def _with_log(source: Source, given: Detections | None, image_rate_hz: float | None) -> Source:
    """Return the source with the detections of its camera, on the clock of the sound."""
    camera = source.camera
    size_px = camera.width_px, camera.height_px
    log = _read(given, lambda path: read_any_detections(path, image_rate_hz, size_px))
    if log is not None:
        log = within_images(camera, log.on_clock(source.start_ns, camera.stamp_offset_s))
    return replace(source, detections=log)


def with_cameras(source: Source, car: CarSensors, detections: Mapping[str, Detections]) -> Source:
    """Return the source with several cameras of a car, each with its detections."""
    channels = {}
    for name, reported in detections.items():
        camera, setup = car.camera(name), car.setups.get(name, CameraSetup())
        rates = source.miss_rates if setup.miss_rates is None else load_miss_rates(setup.miss_rates)
        settings = _with_boxes(source.settings, setup.boxes)
        one = replace(source, camera=camera, miss_rates=rates, settings=settings)
        channels[name] = _with_log(one, reported, setup.image_rate_hz).camera_channel()
    return replace(source, co_evidence=SeveralCameras(channels))


def _with_boxes(settings: ListenSettings, boxes: DetectionFilter) -> ListenSettings:
    """Return settings with the boxes that a camera states, if it states any."""
    return settings if boxes == DetectionFilter() else replace(settings, boxes=boxes)
