"""The whole chain, which converts blocks of sound to one world-state per hop."""

import heapq
import logging
from bisect import insort
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import copy, deepcopy
from dataclasses import dataclass
from functools import partial, wraps
from inspect import signature
from itertools import chain
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, Unpack

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_reader import SequenceReader
from worldstate.abduction.sequence.street_sides import StreetListener
from worldstate.abduction.signature.published_signature import ModelDomain
from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.adapters.audio.sound_file import Audio, RawPcm, open_sound
from worldstate.adapters.camera.detections import DetectionFrame
from worldstate.adapters.camera.vision_query import SENSOR, SeveralCameras, VisionQuery
from worldstate.adapters.files.acoustic_domain import outside_of
from worldstate.adapters.files.checkpoint_file import Checkpoint
from worldstate.core.fixed_lag import LAG_NS, Timed
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.given_spectra import GivenSpectra, SpectrumFrontEnd
from worldstate.frontend.settings import HOP_RATE_HZ
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.ground import InvalidArgumentError, WorldstateError
from worldstate.ground.checks import in_range, one_of
from worldstate.ground.typing import BoolArray, Float32Array
from worldstate.ground.values import integer_ns, nanoseconds, replaced, seconds
from worldstate.measurement.measurement import Measurement
from worldstate.measurement.odometry import Odometry
from worldstate.state import WorldState

from .acoustic import AcousticAdapter
from .own_parts import OtherModality, checked_frame, checked_timed
from .source import Source, SourceParts, check_clocks, check_mounting, open_source

P = ParamSpec("P")
T = TypeVar("T")
_LOG = logging.getLogger(__name__)
# Name of the recording if sound is pushed.
PUSHED = "pushed sound"
# A part is half a hop.
PARTS_PER_SECOND = 20
# Limits of the data that wait for their sound: ten minutes of odometry at 100 Hz, and the boxes of the
# largest file.
MOST_AHEAD, MOST_AHEAD_BYTES = 1 << 16, 64 << 20


@dataclass(frozen=True, slots=True)
class Step:
    """One hop: front-end output, measurement and belief.

    Parameters
    ----------
    frame : AcousticFrame
        Output of the front-end.
    measurement : Measurement
        Measurement that the adapter made from it.
    checkpoint : Checkpoint
        State from which another run continues: the belief, whose snapshot is `state`, and what was learned
        about the site and the street.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from pathlib import Path
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
    checkpoint: Checkpoint

    @property
    def state(self) -> WorldState:
        """The snapshot after the hop."""
        return self.checkpoint.world.state


@dataclass(frozen=True, slots=True)
class Senses:
    """Memory of the front-end and of the cameras between two samples.

    Parameters
    ----------
    now_ns : int
        Time of the next sample.
    ears : FrontEnd
        Sound of the last window, and statistics of the channels.
    eyes : mapping of str to VisionQuery
        Last images of each camera, by its name.
    """

    now_ns: int
    ears: FrontEnd | SpectrumFrontEnd
    eyes: Mapping[str, VisionQuery]


class Listener:
    """Convert blocks of sound of any length to world-states, one per hop (0.1 s).

    Parameters
    ----------
    array : MicrophoneArray, path, name or Source
        Positions of the microphones, as `open_source` takes them. A `Source` contains all of the parts below;
        its sound is not opened.
    sample_rate_hz : float
        Sample rate of the blocks.
    start_s : float, optional
        Time of the first sample on the clock of the states. Default: 0, or the end of the checkpoint of
        another listener.
    spectra : GivenSpectra, optional
        Spatial spectra that another front-end computed for the array of the model; blocks then hold one
        channel. The snapshots state no budget and no audibility.
    **parts
        As `open_source` takes them: `car`, `model`, `camera`, `miss_rates`, `context`, `sides`, `moving_ego`,
        `budget` or `alpha`, `uncalibrated`, `settings`, and `resume`. With the `Checkpoint` of a listener the
        next sample continues it. A file holds no sound: begin a second or more before its time with
        `start_s`; this sound fills the windows.

    Attributes
    ----------
    world : WorldFilter
        The belief after the last hop.

    Raises
    ------
    InvalidArgumentError, OutOfDomainError
        As `open_source`; or if the checkpoint is of a listener with another array, rate or search.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import ovad_array
    >>> import numpy as np
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> listener = Listener(ovad_array(), 48_000)
    >>> [state.time_s for block in np.split(noise, 100) for state in listener.push(block)]
    [1.0, 1.1, 1.2]
    """

    def __init__(
        self,
        array: MicrophoneArray | Path | str | Source,
        sample_rate_hz: float,
        *,
        start_s: float | None = None,
        spectra: GivenSpectra | None = None,
        **parts: Unpack[SourceParts],
    ) -> None:
        self._blind = not isinstance(array, Source) and parts.get("camera") is None
        if isinstance(array, Source) and (parts or start_s is not None):
            given = ", ".join(parts) or "start_s"
            raise InvalidArgumentError(f"{given}: expected nothing beside a source, which has all of it")
        begins_s = start_s or 0.0
        source = array if isinstance(array, Source) else open_source(PUSHED, array, start_s=begins_s, **parts)
        if spectra is not None:
            # No threshold was calibrated with this front-end, so the states give no budget.
            source = replaced(source, policy=replaced(source.policy, alpha=0.0))
        self.world = source.world()
        self._source, self._rate_hz = source, sample_rate_hz
        self._signature, self._reader = source.signature(), source.reader()
        vision = source.co_evidence or source.camera_channel()
        self._cameras = vision.cameras if isinstance(vision, SeveralCameras) else {SENSOR: vision}
        self._adapter = AcousticAdapter(
            source.array,
            sample_rate_hz,
            self._signature,
            start_ns=source.start_ns,
            vision=vision,
            grounding=source.settings.grounding,
            guard=source.guard,
            road_users=source.road_users,
            sequence=self._reader,
            front_end_settings=source.settings.front_end(source.array, sample_rate_hz),
            uncalibrated=source.settings.uncalibrated,
            kinds=source.kinds,
        )
        if spectra is not None:
            self._adapter.take_spectra(spectra, source.start_ns)
        # Measurements before the beginning, or already in the resumed belief, are left out.
        self._since_ns = source.start_ns - 1 if source.before is None else self.world.stamp_ns
        self._waiting = _Waiting(source.others, self._since_ns)
        self._part = max(int(sample_rate_hz / PARTS_PER_SECOND), 1)
        self._first_ns, self._samples, self._warned = source.start_ns, 0, set[str]()
        self._ahead: list[tuple[int, str, Callable[[], int], int]] = []  # In the order of their time stamps
        self._ahead_bytes = 0
        domain: ModelDomain | None = getattr(source.model, "domain", None)
        self._domain, ego = None if source.settings.uncalibrated else domain, self.world.state.ego
        self._speed_mps = 0.0 if ego is None else ego.speed_mps
        senses = None if source.before is None else source.before.senses
        if isinstance(senses, Senses) and start_s is None:
            self._go_on(senses)

    def _go_on(self, senses: Senses) -> None:
        """Continue with the windows of another listener."""
        hear, before = self._adapter.front_end, senses.ears
        one, other = ((of.sample_rate_hz, of.settings) for of in (hear, before))
        if one != other or not np.array_equal(hear.array.positions_m, before.array.positions_m):
            raise InvalidArgumentError("resume: expected the array, rate, bands and azimuths of its listener")
        self._adapter.front_end = deepcopy(before)
        self._first_ns = senses.now_ns  # Later than the belief, by the samples since the last hop
        for name, query in self._cameras.items():
            if name in senses.eyes:
                query.go_on(senses.eyes[name])

    def push(self, block: Float32Array | None) -> list[WorldState]:
        """Take the next samples; return the state after each hop that ends in them.

        Parameters
        ----------
        block : ndarray
            Shape (n, M), any n; floats of full scale 1, int16 or int32. None ends the sound and completes a
            resampled hop.

        Returns
        -------
        list of WorldState
            The first after the first full second, then one every 0.1 s.

        Raises
        ------
        InvalidArgumentError
            For another number of channels, NaN or infinity.
        """
        return [step.state for step in self.steps(block)]

    def add(self, *told: Timed) -> None:
        """Add odometry, positions or measurements of other sensors; each takes effect at its own time stamp.

        A measurement is refused and counted if its time stamp is more than two seconds before the pushed
        sound or, after the next block, more than two seconds ahead of it. A measurement is also refused if
        65,536 others already wait for their sound.
        """
        for one in told:
            self._take(checked_timed("add", one).stamp_ns, one.source, partial(self._waiting.add, one))

    def skip(self, lost_ns: int) -> None:
        """Advance the time by lost sound that is not pushed as silence.

        Push 0.9 s of silence before, so that the snapshot reports lost samples.

        Parameters
        ----------
        lost_ns : int
            Length of the lost sound, nanoseconds.

        Raises
        ------
        InvalidArgumentError
            If it is negative.

        Examples
        --------
        >>> from worldstate.frontend.array.microphone_array import ovad_array
        >>> import numpy as np
        >>> listener = Listener(ovad_array(), 48_000)
        >>> before = listener.push(np.zeros((48_000, 56)))
        >>> listener.skip(2_000_000_000)
        >>> [state.time_s for state in listener.push(np.zeros((4_800, 56)))]
        [3.1]
        """
        self._adapter.front_end.skip(lost_ns)
        self._first_ns += lost_ns
        if isinstance(self._reader, SequenceReader):
            self._reader.miss(round(seconds(lost_ns) * HOP_RATE_HZ))

    def refuse(self, inputs: int, name: str = "", problem: str = "") -> None:
        """Count refused inputs; warn about the first one of a name.

        Raises
        ------
        InvalidArgumentError
            If the count is not a number, or negative.
        """
        self.world = self.world.refused(int(in_range("inputs", inputs, 0, 2**53)))
        if problem and name not in self._warned:
            _LOG.warning("%s: %s", name, problem)
            self._warned.add(name)

    def look(self, stamp_ns: int, frame: DetectionFrame | Any, camera: str = SENSOR) -> None:
        """Add the detections of a running detector in one image.

        An image is refused if its time is more than two seconds before the pushed sound or, after the next
        block, more than two seconds ahead of it. Boxes outside the image are refused, and so are images that
        arrive while 65,536 images or 64 MiB wait for their sound. `WorldState.delivery` counts all of these.

        Parameters
        ----------
        stamp_ns : int
            Time of the image on the clock of the camera, nanoseconds.
        frame : DetectionFrame, or Detections of supervision, or Results of ultralytics
            All boxes of the image.
        camera : str
            Name of the camera, if the source has several.

        Raises
        ------
        InvalidArgumentError
            If there is no such camera, if no camera was given for an array other than OVAD's, or if `frame`
            is not a DetectionFrame.
        InputFileError
            If all boxes are outside the image. An image that waits for its sound is refused later.
        """
        if self._blind:
            check_mounting(self._source.array)
            self._blind = False
        query = self._cameras[one_of("camera", camera, self._cameras)]
        frame = checked_frame("look", frame)
        held_bytes = frame.boxes_px.nbytes + sum(map(len, frame.labels))
        taken_ns = query.taken_ns(integer_ns("stamp_ns", stamp_ns))
        self._take(taken_ns, camera, partial(_seen, query, stamp_ns, frame), held_bytes)

    def _take(self, stamp_ns: int, name: str, take: Callable[[], int], held_bytes: int = 0) -> None:
        """Pass on a measurement near the sound; keep one that is ahead of it."""
        if stamp_ns <= self._now_ns() + LAG_NS:
            if self._is_near(stamp_ns, name):
                self.refuse(take())
        elif len(self._ahead) < MOST_AHEAD and self._ahead_bytes + held_bytes <= MOST_AHEAD_BYTES:
            self._ahead_bytes += held_bytes
            insort(self._ahead, (stamp_ns, name, take, held_bytes), key=itemgetter(0))
        else:
            self.refuse(1, name, f"a measurement is refused, because {len(self._ahead)} wait for their sound")

    def _take_due(self) -> None:
        """Pass on the measurements whose sound has been pushed."""
        while self._ahead and self._ahead[0][0] <= self._now_ns():
            stamp_ns, name, take, held_bytes = self._ahead.pop(0)
            self._ahead_bytes -= held_bytes
            try:
                if self._is_near(stamp_ns, name):
                    self.refuse(take())
            except WorldstateError as error:
                self.refuse(1, name, f"a measurement is refused: {error}")

    def _now_ns(self) -> int:
        """Return the time up to which sound was pushed."""
        return self._first_ns + nanoseconds(self._samples / self._rate_hz)

    def _is_near(self, stamp_ns: int, name: str) -> bool:
        """Return whether a time stamp is near the pushed sound; otherwise count it as refused."""
        far_ns = stamp_ns - self._now_ns()
        if not (near := abs(far_ns) <= LAG_NS):
            got = f"refused, because its time stamp is {seconds(far_ns):.1f} s from the sound"
            self.refuse(1, name, f"a measurement is {got}; at most {seconds(LAG_NS):.0f} s are allowed")
        return near

    def checkpoint(self) -> Checkpoint:
        """Return the state from which another listener continues at the next sample, bit for bit.

        Measurements that still wait for their time, at most 0.1 s of them, must be added again to the other
        listener.

        Examples
        --------
        >>> from worldstate.frontend.array.microphone_array import ovad_array
        >>> import numpy as np
        >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
        >>> listener = Listener(ovad_array(), 48_000)
        >>> earlier = listener.push(noise[:50_000])
        >>> other = Listener(ovad_array(), 48_000, resume=listener.checkpoint())
        >>> other.push(noise[50_000:]) == listener.push(noise[50_000:])
        True
        """
        # The front-end is changed in place and needs a deep copy; the memory of a camera is replaced.
        eyes = {name: copy(query) for name, query in self._cameras.items()}
        senses = Senses(self._now_ns(), deepcopy(self._adapter.front_end), eyes)
        return replaced(self._learned(), senses=senses)

    def _learned(self) -> Checkpoint:
        """Return the belief and the learned site and street."""
        signature, reader = self._signature, self._reader
        site = signature.estimate if isinstance(signature, SiteSignature) else None
        if not isinstance(reader, SequenceReader):
            return Checkpoint(self.world, site)
        hearing = None if reader.street is None else reader.street.hearing
        return Checkpoint(self.world, site, reader.history, hearing)

    def steps(self, block: Float32Array | None) -> Iterator[Step]:
        """Yield the hops that end in the next samples; with None the last hop."""
        reader = self._reader if self._source.settings.site_adaptation else None
        for frame in self._frames(block):
            for other in self._waiting.until(frame.stamp_ns):
                self.world = self.world.update(other)
                self._speed_mps = other.speed_mps if isinstance(other, Odometry) else self._speed_mps
            measurement = self._adapter.interpret(frame, self._outside())
            # After a long loss the belief is predicted first: it refuses measurements far ahead of it.
            if measurement.stamp_ns - self.world.stamp_ns > LAG_NS:
                self.world = self.world.predict_to(measurement.stamp_ns)
            self.world = self.world.update(measurement)
            if isinstance(reader, SequenceReader):
                learn_passes(reader.street, self.world.state)
            yield Step(frame, measurement, self._learned())

    def measured(self, block: Float32Array | None) -> Iterator[tuple[AcousticFrame, Measurement]]:
        """Yield front-end output and measurement of the next hops, without a filter."""
        return ((frame, self._adapter.interpret(frame)) for frame in self._frames(block))

    def _outside(self) -> str | None:
        """Return the reason why the model does not apply at the speed of the ego; warn once."""
        reason = outside_of(self._domain, self._speed_mps)
        if reason is not None:
            self.refuse(0, reason, f"sound at {self._speed_mps:.1f} m/s begins no advisory")
        return reason

    def _frames(self, block: Float32Array | None) -> Iterator[AcousticFrame]:
        """Yield the front-end output of the hops that end in the next samples, or of the last hop."""
        hear, samples = self._adapter.front_end, 0 if block is None else len(block)
        # Parts in which at most one hop ends, so that waiting measurements are passed on before later hops.
        for start in [0] if block is None else range(0, samples, self._part):
            part = None if block is None else block[start : start + self._part]
            frames = hear.finish() if part is None else hear.process(part)
            self._samples += 0 if part is None else len(part)
            self._take_due()
            for frame in frames:
                # Hops that are already in the resumed belief only fill the windows.
                if frame.stamp_ns > self._since_ns:
                    yield frame
        while self._ahead and not self._is_near(*self._ahead[-1][:2]):
            self._ahead_bytes -= self._ahead.pop()[-1]


def _of_recording(opened: Callable[P, Source]) -> Callable[[Callable[[Source], T]], Callable[P, T]]:
    """Turn a function of a source into one with the arguments of `open_source`, which `help` then shows."""

    def decorate(function: Callable[[Source], T]) -> Callable[P, T]:
        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            return function(opened(*args, **kwargs))

        returned = signature(function).return_annotation
        call.__signature__ = signature(opened).replace(return_annotation=returned)  # type: ignore[attr-defined]
        return call

    return decorate


@_of_recording(open_source)
def listen(source: Source) -> Iterator[WorldState]:
    """Yield the world-states of a recording or a stream, one per hop (0.1 s), as the sound is read.

    The first state comes after the first second of sound. `run` returns the same states as a list.

    Parameters
    ----------
    path, array, ...
        As `open_source` takes them.

    Raises
    ------
    InputFileError, InvalidArgumentError, OutOfDomainError
        As `open_source`, at the call; for a file also if its first second of sound is unusable.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (19_200, 7))
    >>> with TemporaryDirectory() as folder:
    ...     soundfile.write(f"{folder}/noise.wav", noise, 16_000)
    ...     [state.time_s for state in listen(f"{folder}/noise.wav", "uma-8")]
    [1.0, 1.1, 1.2]
    """
    steps = listen_steps(source)
    # A generator raises no error before its first item. A stream would block the call.
    first = [] if isinstance(source.sound, RawPcm | Audio) else [step for step in [next(steps, None)] if step]
    return (step.state for step in chain(first, steps))


@_of_recording(open_source)
def run(source: Source) -> list[WorldState]:
    """Return the world-states of a recording, one per hop (0.1 s), as the command of this name writes them.

    Parameters
    ----------
    path, array, ...
        As `open_source` takes them. Each option of the command has the same name.

    Returns
    -------
    list of WorldState
        The first state is that of the first second. `listen` yields them one by one for a long recording.

    Raises
    ------
    InputFileError
        If a file is missing, damaged or does not fit the array.
    InvalidArgumentError, OutOfDomainError
        As `open_source`.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (19_200, 7))
    >>> with TemporaryDirectory() as folder:
    ...     soundfile.write(f"{folder}/noise.wav", noise, 16_000)
    ...     states = run(f"{folder}/noise.wav", array="uma-8")
    >>> len(states), [cue.direction for cue in states[-1].cues]
    (3, ['left', 'right'])
    """
    return [step.state for step in listen_steps(source)]


def listen_steps(source: Source, kept: BoolArray | None = None) -> Iterator[Step]:
    """Yield every hop of a source with its front-end output, measurement and belief.

    Parameters
    ----------
    source : Source
        From `open_source`.
    kept : ndarray of bool, optional
        Seconds that are processed, shape (n,); the others are skipped as by `Listener.skip`. Default: all.

    Yields
    ------
    Step
        One per hop, the first after the first second of sound.

    Raises
    ------
    InputFileError
        If the sound file is damaged or does not fit the array.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     [step.frame.feature.shape for step in listen_steps(open_source(path))]
    [(60,), (60,), (60,)]
    """
    for listener, block in listened(source, kept):
        yield from listener.steps(block)


def measure_steps(source: Source) -> Iterator[tuple[AcousticFrame, Measurement]]:
    """Yield front-end output and measurement of every hop, without a filter, for calibration.

    Parameters
    ----------
    source : Source
        From `open_source`.

    Yields
    ------
    frame, measurement : AcousticFrame, Measurement
        One pair per hop.

    Raises
    ------
    InputFileError
        If the sound file is damaged or does not fit the array.
    OutOfDomainError
        If there is no model for the array.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     [measurement.co_evidence.reason for _, measurement in measure_steps(open_source(path))]
    ['no detections file', 'no detections file', 'no detections file']
    """
    for listener, block in listened(source.read_by_model()):
        yield from listener.measured(block)


def listened(source: Source, kept: BoolArray | None = None) -> Iterator[tuple[Listener, Float32Array | None]]:
    """Yield the sound of a source in blocks, None last, each with the listener that processes it."""
    n_microphones, channels = source.array.n_microphones, source.array.channels
    with open_sound(source.sound, n_microphones, channels=channels, strict=False) as audio:
        if audio.silent_channels:
            silent = ", ".join(map(str, audio.silent_channels))
            _LOG.warning("%s: channel %s is silent and left out", audio.path, silent)
        endless = isinstance(source.sound, RawPcm | Audio)
        check_clocks(source, None if endless else audio.duration_s)
        listener = Listener(source, audio.sample_rate_hz)
        per_second = 1 if kept is not None else PARTS_PER_SECOND
        for number, block in enumerate(audio.blocks(max(audio.sample_rate_hz // per_second, 1))):
            if kept is None or kept[number]:
                yield listener, block
            else:
                listener.skip(nanoseconds(len(block) / audio.sample_rate_hz))
        yield listener, None


def learn_passes(street: StreetListener | None, state: WorldState) -> None:
    """Add to a learned street the arms from which a vehicle has just come into view."""
    if street is None:
        return
    arms = {one.id: one.direction for one in state.entities}
    came = {arms.get(event.entity_id) for event in state.events if event.kind == "handed_over"}
    for arm in SIDES:
        if arm in came:
            street.passed(arm)


def _seen(query: VisionQuery, stamp_ns: int, frame: DetectionFrame) -> int:
    """Add the detections of an image; return the number of refused boxes."""
    before = query.outside
    query.see(stamp_ns, frame)
    return query.outside - before


class _Waiting:
    """Queue of measurements of other sensors, oldest first."""

    def __init__(self, others: Iterable[OtherModality], after_ns: int) -> None:
        merged = heapq.merge(*(one() for one in others), key=attrgetter("stamp_ns"))
        self._after_ns = after_ns
        self._recorded = (one for one in merged if one.stamp_ns > after_ns)
        self._next = next(self._recorded, None)
        self._told: list[Timed] = []

    def add(self, told: Timed) -> int:
        """Add a measurement; return 1 if the queue is full and it is refused."""
        if told.stamp_ns <= self._after_ns or len(self._told) >= MOST_AHEAD:
            return int(told.stamp_ns > self._after_ns)
        insort(self._told, told, key=attrgetter("stamp_ns"))
        return 0

    def until(self, stamp_ns: int) -> Iterator[Timed]:
        """Remove and yield the measurements up to a time."""
        while self._next is not None and self._next.stamp_ns <= stamp_ns:
            yield self._next
            self._next = next(self._recorded, None)
        while self._told and self._told[0].stamp_ns <= stamp_ns:
            yield self._told.pop(0)
