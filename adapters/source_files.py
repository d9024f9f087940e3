"""Find everything that belongs to a recording: its array, model, camera, and what was believed before."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypedDict, TypeVar

from worldstate.abduction.sequence.sequence_model import SequenceModel
from worldstate.abduction.sequence.street_sides import SidePatterns
from worldstate.adapters.audio.open_sound import SoundInput, SoundStream, as_sound, path_of
from worldstate.adapters.camera.camera_channel import video_degradation, watched
from worldstate.adapters.camera.detections import DetectionLog, Detector, read_any_detections
from worldstate.adapters.camera.miss_rates import MissRates, load_miss_rates
from worldstate.adapters.camera.pinhole import PinholeCamera, read_camera
from worldstate.adapters.camera.video import VIDEO_NAME, open_video
from worldstate.adapters.datasets.array_choice import choose_array
from worldstate.adapters.datasets.ovad import Recording
from worldstate.adapters.files.acoustic_domain import UNFIT, array_of, states_budget
from worldstate.adapters.files.array_file import read_array
from worldstate.adapters.files.checkpoint_file import Checkpoint, read_checkpoint
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.adapters.files.odometry_file import OdometryLog
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.feature import CLEANED_FEATURE_VERSION
from worldstate.frontend.ego_noise.ego_noise import EgoNoiseSettings
from worldstate.ground import InputFileError, InvalidArgumentError, NotUsable, in_range, nanoseconds
from worldstate.state import Context

from .own_parts import OtherModality
from .source import ListenSettings, Source

T = TypeVar("T")


class SourceParts(TypedDict, total=False):
    """What `open_source` takes of a recording beside its sound: files, or the objects that they hold."""

    array: Path | str | MicrophoneArray | None
    detections: Path | str | DetectionLog | None
    detector: Detector | None
    camera: Path | str | PinholeCamera | None
    miss_rates: Path | str | MissRates | None
    model: Path | str | Model | None
    context: Context | None
    settings: ListenSettings | None


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
        If the model holds no threshold for the budget, or both detections and a detector are given.
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
    sound = as_sound(path)
    recording = Recording.open(sound) if isinstance(sound, Path) and sound.is_dir() else None
    told = moving_ego or (ego is not None and ego.moves)
    moves = bool(told or (recording and recording.moving_ego) or context.ego_speed_mps)
    known = model if isinstance(model, Model) else read_model(model, moving_ego=moves)
    source = replace(
        _heard(sound, known, _read(array, read_array), context, settings, moves),
        camera=_read(camera, read_camera) or PinholeCamera(),
        miss_rates=_read(miss_rates, load_miss_rates),
        before=_read(resume, read_checkpoint),
        sides=sides,
        start_ns=nanoseconds(in_range("start_s", start_s, 0.0, 1e10))
        or (sound.start_ns if isinstance(sound, SoundStream) else 0),
        others=tuple(others) if ego is None else (*others, ego.told.__iter__),
    )
    if recording is not None:
        hazard_free = recording.label == "none"
        source = replace(source, sound=recording.audio_path, t0_s=recording.t0_s, hazard_free=hazard_free)
    return _with_camera(source, recording, detections, detector)


def _read(given: Path | str | T | None, reader: Callable[[Path | str], T]) -> T | None:
    """Return what a file holds, and what is no path as it is."""
    return reader(given) if isinstance(given, Path | str) else given


def _heard(
    sound: SoundInput,
    model: Model,
    array: MicrophoneArray | None,
    context: Context,
    settings: ListenSettings,
    moves: bool,
) -> Source:
    """Return what is heard, by which array and with which model."""
    if settings.ego_noise is True and model.domain and model.domain.feature == CLEANED_FEATURE_VERSION:
        # Trained without ego-noise: it is taken out of the feature, too.
        settings = replace(settings, ego_noise=EgoNoiseSettings(feature=True))
    alpha, policies = settings.alpha, model.policies
    policy = policies.policies[0] if alpha is None else policies.for_alpha(alpha)
    if array is None and isinstance(sound, SoundStream):
        raise InputFileError(sound.name, "expected --array: such a stream names no microphones")
    assumed = None if model.domain is None else array_of(model.domain)
    heard_by = choose_array(path_of(sound), array, assumed=assumed, trust_given=settings.uncalibrated)
    stated = not settings.uncalibrated and states_budget(model, heard_by, moves)
    return Source(
        sound=sound,
        array=heard_by,
        detections=None,
        model=model.signature,
        policy=policy if stated else replace(policy, alpha=0.0),
        context=context,
        settings=settings,
        guard=model.guard,
        road_users=model.road_users,
        sequence=_sequence_of(model, moves, settings.uncalibrated),
    )


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
    degradation: float | Callable[[int], float]
    if detector is None:
        log, degradation = _detections(detections, recording, source.camera), _degradation(recording, source)
    elif detections is not None or recording is None:
        raise InvalidArgumentError("detector: expected a recording folder with a video and no detections")
    else:
        log, degradation = watched(open_video(recording.path / VIDEO_NAME), detector, source.miss_rates)
    log = None if log is None else log.shifted(source.camera.stamp_offset_s)
    return replace(source, detections=log, degradation=degradation)


def _detections(
    given: Path | str | DetectionLog | None, recording: Recording | None, camera: PinholeCamera
) -> DetectionLog | None:
    """Return what the camera reported: as given, or beside the recording."""
    if given is None and recording is not None:
        given = recording.detections_path
    size_px = camera.width_px, camera.height_px
    return _read(given, lambda path: read_any_detections(path, size_px=size_px))


def _degradation(recording: Recording | None, source: Source) -> float | Callable[[int], float]:
    """Return d as the recording's own video shows it, 0 where there is none to look at."""
    rates = source.miss_rates
    if recording is None or rates is None or rates.health is None:
        return 0.0
    path = recording.path / VIDEO_NAME
    return video_degradation(open_video(path), rates) if path.is_file() else 0.0
