"""The whole chain over a recording: sound in, one world-state a hop out."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Unpack

from worldstate.abduction.sequence.sequence_reader import SequenceReader
from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.adapters.audio.open_sound import SoundInput, open_sound
from worldstate.adapters.files.checkpoint_file import Checkpoint
from worldstate.frontend.stream import AcousticFrame
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Measurement
from worldstate.state import WorldState

from .acoustic import AcousticAdapter, Signature
from .acoustic_sequence import learn_passes
from .own_parts import Waiting
from .source import Source
from .source_files import SourceParts, open_source

BLOCKS_PER_SECOND = 20


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
    world, signature, reader = source.world(), source.signature(), source.reader()
    # What the belief to go on from has taken in already, or what was told before it began, is left out.
    waiting = Waiting(source.others, source.start_ns - 1 if source.before is None else world.stamp_ns)
    measured = measure_steps(source, lambda: world.belief.hypotheses[2], signature, reader)
    for frame, measurement in measured:
        running = () if source.told is None else source.told(measurement.stamp_ns)
        for other in chain(waiting.until(measurement.stamp_ns), running):
            world = world.update(other)
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        site = signature.estimate if isinstance(signature, SiteSignature) else None
        reached = Checkpoint(world, site)
        if isinstance(reader, SequenceReader):
            street = reader.street
            if source.settings.site_adaptation:
                learn_passes(street, world.state)
            hearing = None if street is None else street.hearing
            reached = Checkpoint(world, site, reader.history, hearing)
        yield Step(frame, measurement, reached)


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
        `source.signature()`, where what it has learned is wanted, too.
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
    >>> from pathlib import Path
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
        front_end, since_ns = adapter.front_end, -1 if source.before is None else source.world().stamp_ns
        for block in audio.blocks(max(int(audio.sample_rate_hz / BLOCKS_PER_SECOND), 1)):
            for frame in front_end.process(block):
                # What the belief to go on from has taken in already only fills the windows.
                if frame.stamp_ns <= since_ns:
                    continue
                yield frame, adapter.interpret(frame)
                if none_probability is not None:
                    adapter.set_no_source_probability(none_probability())
