"""Run recordings with a bar that says how far they are."""

from collections.abc import Callable, Iterable
from pathlib import Path

from worldstate.adapters.audio.open_sound import RawPcm, open_sound
from worldstate.adapters.listen import Source, Step
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.operations.calibration.calibration_input import find_inputs, read_input
from worldstate.operations.recordings.hop_table import HopTable
from worldstate.operations.recordings.recording_report import RecordingReport, run_recording

from .progress import progress_bar, track


def listen_with_progress(
    source: Source,
    *,
    title: str,
    states_path: Path | None,
    on_hop: Callable[[Step], None] = lambda step: None,
) -> RecordingReport:
    """Listen to `source` to its end while a bar on standard error counts seconds of audio."""
    hops = None
    if not isinstance(source.sound, RawPcm):
        with open_sound(source.sound, strict=not source.settings.mask_dead) as audio:
            hops = 10.0 * audio.duration_s
    with progress_bar(f"listening to {source.audio_path.name}", hops) as bar:

        def follow(step: Step) -> None:
            on_hop(step)
            bar.advance()

        return run_recording(source, title=title, states_path=states_path, on_hop=follow)


def read_streams(inputs: Iterable[Path], array: MicrophoneArray | None, model: Path | None) -> list[HopTable]:
    """Return the hop streams of data sets, recordings, sound files and what --save-streams wrote."""
    found = [item for path in inputs for item in find_inputs(path)]
    read = track(found, "listening", len(found))
    return [stream for path in read for stream in read_input(path, array=array, model=model)]
