"""The whole chain over blocks of sound: one world-state a hop out."""

import heapq
import logging
from bisect import insort
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Unpack

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_reader import SequenceReader
from worldstate.abduction.sequence.street_sides import StreetListener
from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.adapters.audio.sound_file import Audio, RawPcm, SoundInput, open_sound
from worldstate.adapters.camera.detections import DetectionFrame
from worldstate.adapters.camera.vision_query import SENSOR, SeveralCameras, VisionQuery
from worldstate.adapters.files.checkpoint_file import Checkpoint
from worldstate.core.fixed_lag import LAG_NS, Timed
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.given_spectra import GivenSpectra, SpectrumFrontEnd
from worldstate.frontend.settings import HOP_RATE_HZ
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.ground import InvalidArgumentError
from worldstate.ground.checks import one_of
from worldstate.ground.typing import Float32Array
from worldstate.ground.values import nanoseconds, seconds
from worldstate.measurement.measurement import Measurement
from worldstate.state import WorldState

from .acoustic import AcousticAdapter
from .own_parts import OtherModality
from .source import ListenerParts, Source, SourceParts, check_clocks, check_mounting, open_source

_LOG = logging.getLogger(__name__)
# Stands for the file where sound is pushed.
PUSHED = "pushed sound"
# Half a hop.
PARTS_PER_SECOND = 20


@dataclass(frozen=True, slots=True)
class Step:
    """One hop: what was heard, what was measured, what is believed.

    Parameters
    ----------
    frame : AcousticFrame
        What the front-end read from the sound.
    measurement : Measurement
        What the adapter made of it.
    checkpoint : Checkpoint
        What another run goes on from: the belief after it, whose snapshot is `state`, and what was learned of
        the site and heard of the street up to it.

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
    """What ears and eyes remember between two samples.

    Parameters
    ----------
    ears : FrontEnd
        The sound of the last window, and what the channels' health is judged by.
    eyes : mapping of str to VisionQuery
        The last images of each camera, by its name.
    """

    ears: FrontEnd | SpectrumFrontEnd
    eyes: Mapping[str, VisionQuery]


class Listener:
    """Blocks of sound in, one world-state a hop (0.1 s) out; the same to the bit for blocks of any length.

    Parameters
    ----------
    array : MicrophoneArray, path or Source
        What hears: positions, or a file of them as `read_array` takes it. A `Source` from `open_source` has
        all of the parts below; its sound is not opened.
    sample_rate_hz : float
        Of the blocks.
    start_s : float, optional
        Time of the first sample on the clock of the states; 0 where not given, or with a checkpoint of
        another listener its last sample.
    spectra : GivenSpectra, optional
        Spatial spectra that another front-end computed for the array of the model; blocks then hold one
        channel. The snapshots state no budget, and how well could be heard is null.
    **parts
        As `open_source` takes them: `model`, `camera`, `miss_rates`, `context`, `sides`, `moving_ego`,
        `settings`, and `resume`, a `Checkpoint` or a file of one. The checkpoint of a listener goes on at the
        next sample. One of a file holds no sound: begin a second or more before it with `start_s`; what is
        heard up to its time fills the windows.

    Attributes
    ----------
    world : WorldFilter
        The belief after the last hop.

    Raises
    ------
    InvalidArgumentError, OutOfDomainError
        As `open_source`; or if the checkpoint is that of a listener with another array, rate or search.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import ovad_array
    >>> import numpy as np
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> listener = Listener(ovad_array(), 48_000)
    >>> [state.stamp_ns / 1e9 for block in np.split(noise, 100) for state in listener.push(block)]
    [1.0, 1.1, 1.2]
    """

    def __init__(
        self,
        array: MicrophoneArray | Path | str | Source,
        sample_rate_hz: float,
        *,
        start_s: float | None = None,
        spectra: GivenSpectra | None = None,
        **parts: Unpack[ListenerParts],
    ) -> None:
        self._blind = not isinstance(array, Source) and parts.get("camera") is None
        if not isinstance(array, Source):
            source = open_source(PUSHED, array=array, start_s=start_s or 0.0, **parts)
        elif parts or start_s is not None:
            given = ", ".join(parts) or "start_s"
            raise InvalidArgumentError(f"{given}: expected nothing beside a source, which has all of it")
        else:
            source = array
        if spectra is not None:
            # Nobody has set a threshold with this front-end: no budget is stated.
            source = replace(source, policy=replace(source.policy, alpha=0.0))
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
        )
        if spectra is not None:
            self._adapter.take_spectra(spectra, source.start_ns)
        # What the belief to go on from has taken in already, or what was told before it began, is left out.
        self._since_ns = source.start_ns - 1 if source.before is None else self.world.stamp_ns
        self._waiting = _Waiting(source.others, self._since_ns)
        self._part = max(int(sample_rate_hz / PARTS_PER_SECOND), 1)
        self._first_ns, self._samples, self._warned = source.start_ns, 0, set[str]()
        self._ahead: list[tuple[int, str, Callable[[], None]]] = []
        senses = None if source.before is None else source.before.senses
        if isinstance(senses, Senses) and start_s is None:
            self._go_on(senses)

    def _go_on(self, senses: Senses) -> None:
        """Hear and see on with the windows of another listener."""
        hear, before = self._adapter.front_end, senses.ears
        one, other = ((of.sample_rate_hz, of.settings) for of in (hear, before))
        if one != other or not np.array_equal(hear.array.positions_m, before.array.positions_m):
            raise InvalidArgumentError("resume: expected the array, rate, bands and azimuths of its listener")
        self._adapter.front_end = deepcopy(before)
        self._first_ns = self.world.stamp_ns
        for name, query in self._cameras.items():
            if name in senses.eyes:
                query.go_on(senses.eyes[name])

    def push(self, block: Float32Array | None) -> list[WorldState]:
        """Take the next samples; return the state after each hop that ends in them.

        Parameters
        ----------
        block : ndarray
            Shape (n, M), any n; floats of full scale 1, int16 or int32. None at the end of the sound, where
            a resampled hop still waits for the next samples.

        Returns
        -------
        list of WorldState
            The first after the first full second, then one every 0.1 s.

        Raises
        ------
        InvalidArgumentError
            On another number of channels, NaN or infinity.
        """
        return [step.state for step in self.steps(block)]

    def add(self, *told: Timed) -> None:
        """Take odometry, positions or measurements of other sensors; each counts from its own stamp on.

        What is stamped more than two seconds before the sound, or after what is pushed next, is refused and
        counted.
        """
        for one in told:
            self._take(one.stamp_ns, one.source, partial(self._waiting.add, (one,)))

    def skip(self, lost_ns: int) -> None:
        """Let time go on by sound that was lost and is not pushed as silence.

        Push .9 s of silence before, so that the snapshot says that samples were lost.

        Parameters
        ----------
        lost_ns : int
            Length of the sound, nanoseconds.

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
        >>> [state.stamp_ns / 1e9 for state in listener.push(np.zeros((4_800, 56)))]
        [3.1]
        """
        self._adapter.front_end.skip(lost_ns)
        self._first_ns += lost_ns
        if isinstance(self._reader, SequenceReader):
            self._reader.miss(round(seconds(lost_ns) * HOP_RATE_HZ))

    def refuse(self, inputs: int) -> None:
        """Count so many inputs that were refused before they reached the belief."""
        self.world = self.world.refused(inputs)

    def look(self, stamp_ns: int, frame: DetectionFrame, camera: str = SENSOR) -> None:
        """Take what a running detector found in an image; of several cameras the one is named.

        One that was taken more than two seconds before the sound, or after what is pushed next, is refused,
        and so are boxes outside the image; `WorldState.delivery` counts them.

        Parameters
        ----------
        stamp_ns : int
            When the image was taken by the stamps of the camera, nanoseconds.
        frame : DetectionFrame
            All of its boxes.
        camera : str
            Name of the camera, where the source has several.

        Raises
        ------
        InvalidArgumentError
            If there is no such camera, or none was given, where the array is not OVAD's.
        InputFileError
            If all boxes lie outside the image.
        """
        if self._blind:
            check_mounting(self._source.array)
            self._blind = False
        query = self._cameras[one_of("camera", camera, self._cameras)]
        self._take(query.taken_ns(stamp_ns), camera, partial(self._see, query, stamp_ns, frame))

    def _see(self, query: VisionQuery, stamp_ns: int, frame: DetectionFrame) -> None:
        before = query.outside
        query.see(stamp_ns, frame)
        self.refuse(query.outside - before)

    def _take(self, stamp_ns: int, name: str, take: Callable[[], None]) -> None:
        """Take what is near the sound; what is ahead of it waits for the sound that is pushed next."""
        if stamp_ns > self._now_ns() + LAG_NS:
            self._ahead.append((stamp_ns, name, take))
        elif self._is_near(stamp_ns, name):
            take()

    def _now_ns(self) -> int:
        """Return the time of the sound up to which it was pushed."""
        return self._first_ns + nanoseconds(self._samples / self._rate_hz)

    def _is_near(self, stamp_ns: int, name: str) -> bool:
        """Return whether a stamp is near the sound that was pushed; else count it, and warn of the first."""
        now_ns = self._now_ns()
        if abs(stamp_ns - now_ns) <= LAG_NS:
            return True
        self.refuse(1)
        if name not in self._warned:
            told = "%s: what is stamped %.1f s from the sound is refused, and all that is more than %.0f s"
            _LOG.warning(told, name, seconds(stamp_ns - now_ns), seconds(LAG_NS))
        self._warned.add(name)
        return False

    def checkpoint(self) -> Checkpoint:
        """Return what another listener goes on from at the next sample, to the bit.

        What was told and waits for its time, at most 0.1 s of it, is told again to the other.

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
        # Ears are changed by what they hear, a camera's memory is replaced.
        eyes = {name: copy(query) for name, query in self._cameras.items()}
        return replace(self._learned(), senses=Senses(deepcopy(self._adapter.front_end), eyes))

    def _learned(self) -> Checkpoint:
        """Return the belief and what was learned of site and street."""
        signature, reader = self._signature, self._reader
        site = signature.estimate if isinstance(signature, SiteSignature) else None
        if not isinstance(reader, SequenceReader):
            return Checkpoint(self.world, site)
        hearing = None if reader.street is None else reader.street.hearing
        return Checkpoint(self.world, site, reader.history, hearing)

    def steps(self, block: Float32Array | None) -> Iterator[Step]:
        """Yield the hops that end in the next samples, or wait at the end, as heard and measured."""
        reader = self._reader if self._source.settings.site_adaptation else None
        for frame, measurement in self.measured(block):
            for other in self._waiting.until(measurement.stamp_ns):
                self.world = self.world.update(other)
            self.world = self.world.predict_to(measurement.stamp_ns).update(measurement)
            self._adapter.set_no_source_probability(self.world.belief.hypotheses[2])
            if isinstance(reader, SequenceReader):
                learn_passes(reader.street, self.world.state)
            yield Step(frame, measurement, self._learned())

    def measured(self, block: Float32Array | None) -> Iterator[tuple[AcousticFrame, Measurement]]:
        """Yield the hops that end in the next samples as they were heard and measured, nothing filtered."""
        hear = self._adapter.front_end
        begins_ns = self._now_ns()
        self._samples += 0 if block is None else len(block)
        ahead, self._ahead = self._ahead, []
        for stamp_ns, name, take in ahead:
            # A block may be long, and what lies within it is as near to the sound as can be.
            if begins_ns <= stamp_ns <= self._now_ns() or self._is_near(stamp_ns, name):
                take()
        for frames in [hear.finish()] if block is None else map(hear.process, self._parts(block)):
            for frame in frames:
                # What the belief to go on from has taken in already only fills the windows.
                if frame.stamp_ns > self._since_ns:
                    yield frame, self._adapter.interpret(frame)

    def _parts(self, block: Float32Array) -> Iterator[Float32Array]:
        """Cut a block so that no two hops end in one part."""
        # What is believed after a hop weighs what is learned of ego-noise in the next.
        return (block[start : start + self._part] for start in range(0, len(block), self._part))


def listen(path: SoundInput | str | Sequence[str], **parts: Unpack[SourceParts]) -> Iterator[WorldState]:
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
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     [(state.stamp_ns / 1e9, len(state.entities)) for state in listen(path)]
    [(1.0, 0), (1.1, 0), (1.2, 0)]
    """
    for step in listen_steps(open_source(path, **parts)):
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
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     [step.frame.feature.shape for step in listen_steps(open_source(path))]
    [(60,), (60,), (60,)]
    """
    for listener, block in listened(source):
        yield from listener.steps(block)


def measure_steps(source: Source) -> Iterator[tuple[AcousticFrame, Measurement]]:
    """Yield every hop of `source` as it was heard and measured, nothing filtered: what calibration needs.

    Ego-noise is not learned, which takes a belief that nothing is there.

    Parameters
    ----------
    source : Source
        What to listen to.

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
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     [measurement.co_evidence.reason for _, measurement in measure_steps(open_source(path))]
    ['no detections file', 'no detections file', 'no detections file']
    """
    for listener, block in listened(source):
        yield from listener.measured(block)


def listened(source: Source) -> Iterator[tuple[Listener, Float32Array | None]]:
    """Yield the sound of `source` block by block, None last, each beside the one listener to take it."""
    strict, n_microphones = not source.settings.mask_dead, source.array.n_microphones
    with open_sound(source.sound, n_microphones, channels=source.array.channels, strict=strict) as audio:
        endless = isinstance(source.sound, RawPcm | Audio)
        check_clocks(source, None if endless else audio.duration_s)
        listener = Listener(source, audio.sample_rate_hz)
        for block in audio.blocks(max(audio.sample_rate_hz // PARTS_PER_SECOND, 1)):
            yield listener, block
        yield listener, None


def learn_passes(street: StreetListener | None, state: WorldState) -> None:
    """Tell a street out of which of its arms a vehicle has just come into view."""
    if street is None:
        return
    arms = {one.id: one.direction for one in state.entities}
    came = {arms.get(event.entity_id) for event in state.events if event.kind == "handed_over"}
    for arm in SIDES:
        if arm in came:
            street.passed(arm)


class _Waiting:
    """Measurements of other sensors that wait for their time, oldest first."""

    def __init__(self, others: Iterable[OtherModality], after_ns: int) -> None:
        merged = heapq.merge(*(one() for one in others), key=attrgetter("stamp_ns"))
        self._after_ns = after_ns
        self._recorded = (one for one in merged if one.stamp_ns > after_ns)
        self._next = next(self._recorded, None)
        self._told: list[Timed] = []

    def add(self, told: Iterable[Timed]) -> None:
        """Take what has just been measured."""
        for one in told:
            if one.stamp_ns > self._after_ns:
                insort(self._told, one, key=attrgetter("stamp_ns"))

    def until(self, stamp_ns: int) -> Iterator[Timed]:
        """Yield what was measured up to a time and has not been yielded before."""
        while self._next is not None and self._next.stamp_ns <= stamp_ns:
            yield self._next
            self._next = next(self._recorded, None)
        while self._told and self._told[0].stamp_ns <= stamp_ns:
            yield self._told.pop(0)
