"""The whole chain over a recording: sound in, one world-state a hop out."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.road_users import RoadUserModel
from worldstate.abduction.sequence.sequence_model import SequenceModel
from worldstate.abduction.sequence.sequence_reader import SequenceHistory, SequenceReader
from worldstate.abduction.sequence.street_sides import SidePatterns, StreetHearing
from worldstate.abduction.signature.domain_guard import DomainGuard
from worldstate.abduction.signature.ensemble import AnySignature, EnsembleModel
from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings, SiteSignature
from worldstate.adapters.audio.open_sound import SoundInput, SoundStream, as_sound, open_sound, path_of
from worldstate.adapters.camera.camera_channel import Watcher, video_degradation
from worldstate.adapters.camera.detection_formats import read_any_detections
from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog, Detector
from worldstate.adapters.camera.miss_rates import MissRates, load_miss_rates
from worldstate.adapters.camera.pinhole import PinholeCamera, read_camera
from worldstate.adapters.camera.video import VIDEO_NAME, open_video
from worldstate.adapters.camera.vision_query import VisionQuery, VisionSettings
from worldstate.adapters.datasets.array_choice import choose_array
from worldstate.adapters.datasets.ovad import Recording
from worldstate.adapters.files.acoustic_domain import array_of, states_budget
from worldstate.adapters.files.array_file import read_array
from worldstate.adapters.files.checkpoint_file import Checkpoint, read_checkpoint
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.adapters.files.odometry_file import EngineSpeed, OdometryLog, read_engine
from worldstate.core.filter import WorldFilter
from worldstate.core.fixed_lag import Timed
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.feature import CLEANED_FEATURE_VERSION, feature_nfft
from worldstate.frontend.ego_noise.ego_noise import EgoNoiseSettings
from worldstate.frontend.settings import FrontEndSettings, default_band_hz
from worldstate.frontend.stream import AcousticFrame
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.values import NotUsable, nanoseconds, seconds
from worldstate.measurement.measurement import CoEvidenceChannel, Measurement
from worldstate.measurement.sector import Sector
from worldstate.state import Context, WorldState

from .acoustic import AcousticAdapter, Signature
from .acoustic_grounding import Grounding
from .acoustic_sequence import learn_passes, sequence_of, street_listener
from .own_parts import OtherModality, Waiting

BLOCKS_PER_SECOND = 20


@dataclass(frozen=True, slots=True)
class ListenSettings:
    """How a recording is listened to; the defaults are those of `worldstate run`.

    Parameters
    ----------
    alpha : float or None
        False-positive budget that the threshold was set for; the model file says which it holds. None takes
        the first one, for those who only measure.
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
    >>> ListenSettings(azimuth_span_deg=360).grid_deg
    (-180.0, 180.0)
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
        self.site()  # what is wrong with the time constant is said here

    @property
    def grid_deg(self) -> tuple[float, float]:
        """First and last azimuth that is searched, degrees."""
        return -0.5 * self.azimuth_span_deg, 0.5 * self.azimuth_span_deg

    def front_end(self, array: MicrophoneArray, sample_rate_hz: float) -> FrontEndSettings:
        """Return the front-end's settings for an array and a sample rate."""
        ego_noise = self.ego_noise
        return FrontEndSettings(
            nfft=feature_nfft(sample_rate_hz),
            azimuth_span_deg=self.grid_deg,
            srp_band_hz=self.band_hz or default_band_hz(array, sample_rate_hz),
            ego_noise=(EgoNoiseSettings() if ego_noise else None)
            if isinstance(ego_noise, bool)
            else ego_noise,
        )

    def site(self) -> SiteEstimateSettings | None:
        """Return how the site is learned, None for not at all."""
        if not self.site_adaptation:
            return None
        return (
            SiteEstimateSettings() if self.forgetting_s is None else SiteEstimateSettings(self.forgetting_s)
        )


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
    model : SignatureModel or EnsembleModel
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
    site : SiteEstimate or None
        What is known of the site beforehand, from a checkpoint.
    resume : WorldFilter or None
        Belief to go on from; hops up to its time are heard, which fills the windows, and not measured.
    start_ns : int
        Time of the first sample on the clock of that belief.
    engine : EngineSpeed or None
        Of the own vehicle, whose lines are then cancelled together with its learned noise.
    guard : DomainGuard or None
        Tells sounds that the model was not made for.
    road_users : RoadUserModel or None
        Tells which kind of road user is heard.
    sequence : SequenceModel, NotUsable or None
        Reads who comes into view and when; or why the model's cannot be used here.
    history : SequenceHistory or None
        What it has heard beforehand, from a checkpoint.
    sides : SidePatterns or None
        What either arm of a known street sounds like.
    street : StreetHearing or None
        What of it was heard beforehand, from a checkpoint; then `sides` are not read.
    co_evidence : CoEvidenceChannel or None
        Asked in place of the detections: a camera that runs.
    others : tuple of callables
        What other sensors measured, odometry too, each returning it in the order of stamps on the clock of
        the sound.
    told : callable or None
        Asked once a hop what sensors that run have told up to its stamp.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
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
    model: AnySignature
    policy: CueingPolicy
    context: Context
    settings: ListenSettings = field(default_factory=ListenSettings)
    t0_s: float | None = None
    hazard_free: bool = False
    camera: PinholeCamera = field(default_factory=PinholeCamera)
    miss_rates: MissRates | None = None
    degradation: float | Callable[[int], float] = 0.0
    site: SiteEstimate | None = None
    resume: WorldFilter | None = None
    start_ns: int = 0
    engine: EngineSpeed | None = None
    guard: DomainGuard | None = None
    road_users: RoadUserModel | None = None
    sequence: SequenceModel | NotUsable | None = None
    history: SequenceHistory | None = None
    sides: SidePatterns | None = None
    street: StreetHearing | None = None
    co_evidence: CoEvidenceChannel | None = None
    others: tuple[OtherModality, ...] = ()
    told: Callable[[int], Iterable[Timed]] | None = None

    def world(self) -> WorldFilter:
        """Return the belief before the first hop."""
        if self.resume is None:
            return WorldFilter(context=self.context, policy=self.policy)
        return replace(self.resume, policy=self.policy)

    @property
    def audio_path(self) -> Path:
        """The sound file; of several the first, and a pipe's name."""
        return path_of(self.sound)

    def signature(self) -> Signature:
        """Return the model as it is at the start of the recording; one that learns its site learns anew."""
        site = self.settings.site()
        if site is None or not isinstance(self.model, EnsembleModel):
            return self.model
        return SiteSignature(self.model, site, estimate=self.site)

    def reader(self) -> SequenceReader | NotUsable | None:
        """Return the sequence model as it is at the start of the recording, or why it cannot be used."""
        known = self.sequence
        if not isinstance(known, SequenceModel):
            return known
        listener = street_listener(getattr(self.model, "domain", None), self.sides, self.street)
        return SequenceReader(known, self.history, listener)

    def camera_channel(self) -> VisionQuery:
        """Return the camera's detections as the channel that is asked for co-evidence."""
        rates = self.miss_rates
        return VisionQuery(
            self.camera,
            self.detections,
            rates.table if rates is not None else None,
            self.degradation,
            VisionSettings(keep=self.settings.boxes),
            line_of_sight=unoccluded_sector(self.context),
            clutter=rates.clutter_rate if rates is not None else None,
        )


@dataclass(frozen=True, slots=True)
class Step:
    """One hop: what was heard, what was measured, what is believed.

    Parameters
    ----------
    frame : AcousticFrame
        What the front-end read from the sound.
    measurement : Measurement
        What the adapter made of it.
    world : WorldFilter
        The belief after it; `state` is its snapshot.
    site : SiteEstimate or None
        What is known of the site after it; None where no site is learned.
    history : SequenceHistory or None
        What a sequence model has heard up to it; None without one.
    street : StreetHearing or None
        What was learned of the street's sound up to it; likewise.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     steps = list(listen_steps(open_source(path)))
    >>> steps[0].frame.stamp_ns == steps[0].measurement.stamp_ns == steps[0].state.stamp_ns
    True
    """

    frame: AcousticFrame
    measurement: Measurement
    world: WorldFilter
    site: SiteEstimate | None = None
    history: SequenceHistory | None = None
    street: StreetHearing | None = None

    @property
    def state(self) -> WorldState:
        """The snapshot after the hop."""
        return self.world.state

    @property
    def checkpoint(self) -> Checkpoint:
        """What another run goes on from."""
        return Checkpoint(self.world, self.site, self.history, self.street)


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
    engine: Path | str | EngineSpeed | None = None,
    ego: OdometryLog | None = None,
    others: Sequence[OtherModality] = (),
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
        What took the images, as `read_camera` reads it; OVAD's camera where not given.
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
        learned on, or from nothing, from whoever comes into view. What another array heard is left out, and a
        warning says so.
    resume : path or Checkpoint, optional
        Belief and site to go on from. Hops up to its time are heard, which fills the windows, and not
        measured: the same recording again goes on where the other run ended.
    start_s : float
        Time of the first sample on the clock of that belief, for a recording that follows another; a stream
        with a clock of its own brings it.
    engine : path or EngineSpeed, optional
        Speed of the own engine, as `read_engine` reads it; its lines are cancelled, with `ego_noise` only.
    ego : OdometryLog, optional
        How the ego vehicle moves, in place of the one speed of the context.
    others : sequence of callables, optional
        What other sensors measured: functions that return `Measurement` and `PositionScan` in their order.
    settings : ListenSettings, optional
        How it is listened to: budget, band, azimuths, site adaptation, ego-noise, boxes.

    Returns
    -------
    Source
        For `listen_steps`.

    Raises
    ------
    InputFileError
        If a file is missing or damaged; the message names it.
    InvalidArgumentError
        If the model holds no threshold for the budget, both detections and a detector are given, or an engine
        without `ego_noise`.
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
    ...     source = open_source(path, settings=ListenSettings(alpha=0.05))
    >>> len(source.array.positions_m), source.policy.alpha
    (56, 0.05)
    """
    settings, context = settings or ListenSettings(), context or Context()
    if engine is not None and not settings.ego_noise:
        raise InvalidArgumentError("engine: expected ego_noise with it, which cancels its lines")
    sound = as_sound(path)
    source, recording = _heard(sound, array, model, context, settings, ego is not None and ego.moves)
    source = _with_camera(source, recording, detections, detector, camera, miss_rates)
    if source.detections is not None:
        source = replace(source, detections=source.detections.shifted(source.camera.stamp_offset_s))
    before = read_checkpoint(resume) if isinstance(resume, Path | str) else resume
    return replace(
        source,
        site=None if before is None else before.site,
        sides=sides,
        street=None if before is None else before.street,
        history=None if before is None else before.history,
        resume=None if before is None else before.world,
        start_ns=nanoseconds(in_range("start_s", start_s, 0.0, 1e10))
        or (sound.start_ns if isinstance(sound, SoundStream) else 0),
        others=tuple(others) if ego is None else (*others, ego.told.__iter__),
        engine=read_engine(engine) if isinstance(engine, Path | str) else engine,
    )


def _heard(
    sound: SoundInput,
    array: Path | str | MicrophoneArray | None,
    given: Path | str | Model | None,
    context: Context,
    settings: ListenSettings,
    driven: bool,
) -> tuple[Source, Recording | None]:
    """Return what is heard and by which array and model, and the recording folder if it is one."""
    recording = Recording.open(sound) if isinstance(sound, Path) and sound.is_dir() else None
    moves = driven or bool(recording and recording.moving_ego) or bool(context.ego_speed_mps)
    model = given if isinstance(given, Model) else read_model(given, moving_ego=moves)
    settings = _as_trained(settings, model)
    policy = _policy(model, settings.alpha)
    heard_by = _array(sound, array, model, settings)
    stated = not settings.uncalibrated and states_budget(model, heard_by, moves)
    source = Source(
        sound=recording.audio_path if recording else sound,
        array=heard_by,
        detections=None,
        model=model.signature,
        policy=policy if stated else replace(policy, alpha=0.0),
        context=context,
        settings=settings,
        t0_s=recording.t0_s if recording else None,
        hazard_free=recording is not None and recording.label == "none",
        guard=model.guard,
        road_users=model.road_users,
        sequence=sequence_of(model, moves, settings.uncalibrated),
    )
    return source, recording


def _as_trained(settings: ListenSettings, model: Model) -> ListenSettings:
    """Return settings that take ego-noise out of the feature, too, where the model was trained without it."""
    cleaned = model.domain is not None and model.domain.feature == CLEANED_FEATURE_VERSION
    if settings.ego_noise is True and cleaned:
        return replace(settings, ego_noise=EgoNoiseSettings(feature=True))
    return settings


def _with_camera(
    source: Source,
    recording: Recording | None,
    detections: Path | str | DetectionLog | None,
    detector: Detector | None,
    camera: Path | str | PinholeCamera | None,
    miss_rates: Path | str | MissRates | None,
) -> Source:
    """Return the source with what the camera reported and how well it sees."""
    lens = read_camera(camera) if isinstance(camera, Path | str) else camera or PinholeCamera()
    rates = load_miss_rates(miss_rates) if isinstance(miss_rates, Path | str) else miss_rates
    source = replace(source, camera=lens, miss_rates=rates)
    if detector is None:
        found = _detections(detections, recording, lens)
        return replace(source, detections=found, degradation=_degradation(recording, rates))
    if detections is not None or recording is None:
        raise InvalidArgumentError("detector: expected a recording folder with a video and no detections")
    video = open_video(recording.path / VIDEO_NAME)
    # Each image is decoded once, for its boxes and for its quality.
    watcher = Watcher(detector, rates, str(video.path))
    for number, image in enumerate(video.frames()):
        watcher.look(nanoseconds(number / video.frame_rate_hz), image)
    watched = watcher.watched()
    return replace(source, detections=watched.detections, degradation=watched.degradation)


def _array(
    sound: SoundInput, given: Path | str | MicrophoneArray | None, model: Model, settings: ListenSettings
) -> MicrophoneArray:
    """Return the array that the sound was recorded with: as given, the data set's or the model's."""
    microphones = read_array(given) if isinstance(given, Path | str) else given
    if microphones is None and isinstance(sound, SoundStream):
        raise InputFileError(sound.name, "expected --array: such a stream names no microphones")
    assumed = None if model.domain is None else array_of(model.domain)
    return choose_array(path_of(sound), microphones, assumed=assumed, trust_given=settings.uncalibrated)


def _policy(model: Model, alpha: float | None) -> CueingPolicy:
    """Return the policy of a budget, the first one without."""
    return model.policies.policies[0] if alpha is None else model.policies.for_alpha(alpha)


def _detections(
    given: Path | str | DetectionLog | None, recording: Recording | None, camera: PinholeCamera
) -> DetectionLog | None:
    """Return what the camera reported: as given, or beside the recording."""
    if isinstance(given, DetectionLog):
        return given
    path = given if given is not None else recording and recording.detections_path
    return None if path is None else read_any_detections(path, size_px=(camera.width_px, camera.height_px))


def _degradation(recording: Recording | None, rates: MissRates | None) -> float | Callable[[int], float]:
    """Return d as the recording's own video shows it, 0 where there is none to look at."""
    if recording is None or rates is None or rates.health is None:
        return 0.0
    path = recording.path / VIDEO_NAME
    return video_degradation(open_video(path), rates) if path.is_file() else 0.0


def listen(
    path: SoundInput | str | Sequence[str],
    *,
    array: Path | str | MicrophoneArray | None = None,
    detections: Path | str | DetectionLog | None = None,
    detector: Detector | None = None,
    camera: Path | str | PinholeCamera | None = None,
    miss_rates: Path | str | MissRates | None = None,
    model: Path | str | Model | None = None,
    context: Context | None = None,
    settings: ListenSettings | None = None,
) -> Iterator[WorldState]:
    """Yield one world-state a hop (0.1 s) from a sound file or recording folder.

    Parameters
    ----------
    path : path, sequence of paths, SoundStream or Audio
        Multichannel sound file, a recording folder in the OVAD layout, a file a microphone in their order,
        a stream (raw samples from a pipe, the sound of a bag), or an open recording.
    array, detections, detector, camera, miss_rates, model, context, settings
        As `open_source` takes them: files, or the objects that they hold.

    Yields
    ------
    WorldState
        The first after the first second of sound.

    Raises
    ------
    InputFileError
        If a file is missing or damaged; the message names it.
    InvalidArgumentError
        As `open_source`.

    Examples
    --------
    A second and a fifth of noise:

    >>> import numpy as np
    >>> import soundfile
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     [(state.stamp_ns / 1e9, len(state.entities)) for state in listen(path)]
    [(1.0, 0), (1.1, 0), (1.2, 0)]
    """
    source = open_source(
        path,
        array=array,
        detections=detections,
        detector=detector,
        camera=camera,
        miss_rates=miss_rates,
        model=model,
        context=context,
        settings=settings,
    )
    for step in listen_steps(source):
        yield step.state


def listen_steps(source: Source) -> Iterator[Step]:
    """Yield every hop of `source` with what was heard and measured.

    Parameters
    ----------
    source : Source
        From `open_source`.

    Yields
    ------
    Step
        One a hop, the first after the first second of sound.

    Raises
    ------
    InputFileError
        If the sound file is damaged or does not fit the array.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     [step.frame.feature.shape for step in listen_steps(open_source(path))]
    [(60,), (60,), (60,)]
    """
    world, signature, reader = source.world(), source.signature(), source.reader()
    # What the belief to go on from has taken in already, or what was told before it began, is left out.
    waiting = Waiting(source.others, source.start_ns - 1 if source.resume is None else world.stamp_ns)
    measured = measure_steps(source, lambda: world.explanation.none, signature, reader)
    for frame, measurement in measured:
        running = () if source.told is None else source.told(measurement.stamp_ns)
        for other in chain(waiting.until(measurement.stamp_ns), running):
            world = world.update(other)
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        site = signature.estimate if isinstance(signature, SiteSignature) else None
        if not isinstance(reader, SequenceReader):
            yield Step(frame, measurement, world, site)
            continue
        street = reader.street
        if source.settings.site_adaptation:
            learn_passes(street, world.state)
        hearing = None if street is None else street.hearing
        yield Step(frame, measurement, world, site, reader.history, hearing)


def measure_steps(
    source: Source,
    none_probability: Callable[[], float] | None = None,
    signature: Signature | None = None,
    reader: SequenceReader | NotUsable | None = None,
) -> Iterator[tuple[AcousticFrame, Measurement]]:
    """Yield every hop of `source` as it was heard and measured, nothing filtered: what calibration needs.

    Parameters
    ----------
    source : Source
        What to listen to.
    none_probability : callable, optional
        Asked after every hop for the belief that nothing is there, which gates the learning of ego-noise;
        without it none is learned.
    signature : Signature, optional
        `source.signature()`, for those who want to know what it has learned.
    reader : SequenceReader or NotUsable, optional
        `source.reader()`, likewise.

    Yields
    ------
    frame, measurement : AcousticFrame, Measurement
        One pair a hop.

    Raises
    ------
    InputFileError
        If the sound file is damaged or does not fit the array.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     [measurement.co_evidence.reason for _, measurement in measure_steps(open_source(path))]
    ['no detections file', 'no detections file', 'no detections file']
    """
    strict, n_microphones = not source.settings.mask_dead, source.array.n_microphones
    with open_sound(source.sound, expect_channels=n_microphones, strict=strict) as audio:
        adapter = AcousticAdapter(
            source.array,
            audio.sample_rate_hz,
            signature or source.signature(),
            start_ns=source.start_ns,
            vision=source.co_evidence or source.camera_channel(),
            grounding=source.settings.grounding,
            guard=source.guard,
            road_users=source.road_users,
            sequence=reader or source.reader(),
            front_end_settings=source.settings.front_end(source.array, audio.sample_rate_hz),
            uncalibrated=source.settings.uncalibrated,
        )
        front_end, since_ns = adapter.front_end, -1 if source.resume is None else source.resume.stamp_ns
        rate_hz, taken = audio.sample_rate_hz, 0
        for block in audio.blocks(max(int(rate_hz / BLOCKS_PER_SECOND), 1)):
            if source.engine is not None:
                front_end.follow_engine(source.engine.at(seconds(source.start_ns) + taken / rate_hz))
                taken += len(block)
            for frame in front_end.process(block):
                # What the belief to go on from has taken in already only fills the windows.
                if frame.stamp_ns <= since_ns:
                    continue
                yield frame, adapter.interpret(frame)
                if none_probability is not None:
                    adapter.set_no_source_probability(none_probability())


def unoccluded_sector(context: Context) -> Sector:
    """Return the directions that no occluder of the context hides.

    Examples
    --------
    >>> sector = unoccluded_sector(Context())
    >>> bool(sector.touches(0.5)), bool(sector.touches(0.7))
    (True, False)
    """
    return Sector.in_sight(occluder.edge_azimuth_rad for occluder in context.occluders)
