"""Process each recording of a corpus once, on any number of processes or computers, into Parquet tables."""

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.files.array_file import file_of_model
from worldstate.adapters.files.file_io import read_json, write_json
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.adapters.listener import listen_steps
from worldstate.adapters.source import Source, SourceParts, SourceSensors, open_source, settings_with
from worldstate.adapters.state_log import PARQUET, is_own_mcap, read_log
from worldstate.belief.street_model import StreetModel
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import cross_spectra
from worldstate.frontend.spectra.stft import StreamingStft, band_bins
from worldstate.ground import TINY, InputFileError, InvalidArgumentError, MissingExtraError, WorldstateError
from worldstate.ground.extras import check_extra
from worldstate.ground.parallel import in_executor, in_processes
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.version import __version__
from worldstate.operations.recordings.hop_table import HOP_S, STREAM_COLUMNS, hop_stream, signature_checksum

from .approach_meter import ApproachMeter, alarm_level
from .corpus_inputs import CARD_NAME, LOG_SUFFIX, CorpusInput, file_digest, find_corpus, share_of
from .corpus_tables import TABLES, HeardApproach, HeardHop, HeardRecording, StateHours, write_table

_IN_SETTINGS = "settings", "budget", "alpha", "uncalibrated"
# Version of the tables; each major version reads only its own.
_SCHEMA = {"name": "worldstate.Corpus", "version": "1.0.0"}


@dataclass(frozen=True, slots=True)
class HeardShard:
    """Result of a run for one recording."""

    recording: str
    shard: str  # Name of its file in every table, without the suffix
    status: str  # "heard"; "there" if from an earlier run; "failed"
    sound_s: float = 0.0
    failure: str | None = None


@dataclass(frozen=True, slots=True)
class HearPlan:
    """Settings for every recording of a corpus, and the folder of its tables."""

    out: Path
    array: MicrophoneArray | None
    model: Path | None
    others: dict[str, Any]  # Further arguments of `open_source`
    card: dict[str, Any]  # Description of the folder, with a digest of everything but the recordings

    @classmethod
    def begun(
        cls,
        out: Path,
        hops: bool,
        cascade: bool,
        array: Path | str | MicrophoneArray | None,
        parts: SourceParts,
    ) -> "HearPlan":
        """Create the folder and return the plan; refuse a folder that was created with other settings."""
        others: dict[str, Any] = {
            name: Path(one).absolute() if isinstance(one, Path | str) else one
            for name, one in parts.items()
            if one is not None and name not in ("car", "camera", "model", *_IN_SETTINGS)
        }
        asked: dict[str, Any] = {name: one for name, one in parts.items() if name in _IN_SETTINGS}
        sensors = SourceSensors.of(array, parts.get("car"), parts.get("camera"))
        array, model = sensors.car.array, parts.get("model") or sensors.car.model
        if sensors.camera is not None:
            others["camera"] = sensors.camera
        others["settings"] = sensors.boxes_in(settings_with(**asked))
        if sensors.setup.miss_rates is not None:
            others.setdefault("miss_rates", sensors.setup.miss_rates.absolute())
        if isinstance(model, Model):
            raise InvalidArgumentError("model: expected a file or the name of a shipped model")
        read_model(model, array=array)  # Rejects a wrong model before the work starts
        file = file_of_model(model, array)
        # The digest depends on the microphones of an array, not on its file name.
        decides = [__version__, hops, cascade, array and (array.positions_m, array.channels), file, others]
        text = json.dumps(decides, sort_keys=True, default=_plain)
        card: dict[str, Any] = {"schema": _SCHEMA, "version": __version__, "model": file.name}
        card |= {"array": array and Path(array.name).name, "hops": hops, "cascade": cascade}
        card["digest"] = hashlib.sha256(text.encode()).hexdigest()
        for table in TABLES:
            (out / table).mkdir(parents=True, exist_ok=True)
        if not (out / CARD_NAME).exists():
            write_json(out / CARD_NAME, card, indent=1)
        elif (known := read_json(out / CARD_NAME, "the card of a corpus")) != card:
            held = known if isinstance(known, dict) else {}
            other = {name: one for name, one in card.items() if held.get(name) != one and name != "digest"}
            problem = f"expected the settings of its first run, got {other or 'other options'}: another --out"
            raise InputFileError(out / CARD_NAME, problem)
        return cls(out, array, model and file.absolute(), others, card)

    def shard(self, one: CorpusInput, content: str) -> str:
        """Return the file name of a recording, from everything that determines its bytes."""
        whole = hashlib.sha256(f"{self.card['digest']} {content}".encode()).hexdigest()[:32]
        # An empty content means that the recording could not be read, so the next run tries again.
        return f"{one.key}-{whole if content else 'unread'}"

    def file(self, table: str, shard: str) -> Path:
        """Return the file of a shard in a table."""
        return self.out / table / f"{shard}{PARQUET}"


def _plain(value: Any) -> Any:
    """Return a value in the form that enters the digest."""
    if is_dataclass(value):
        return [type(value).__name__, *(getattr(value, one.name) for one in fields(value))]
    if isinstance(value, Path):
        return file_digest(value).hex()
    return sorted(value) if isinstance(value, frozenset) else np.asarray(value).tolist()


def hear(
    corpus: Path | str,
    out: Path | str,
    array: Path | str | MicrophoneArray | None = None,
    *,
    jobs: int = 1,
    executor: Executor | None = None,
    shard: tuple[int, int] = (1, 1),
    hops: bool = False,
    cascade: bool = False,
    on_recording: Callable[[HeardShard], object] = lambda shard: None,
    **parts: Unpack[SourceParts],
) -> list[HeardShard]:
    """Process every recording of a corpus and write its approaches as Parquet.

    A recording that was processed before is skipped. The names of its files contain a digest of its content,
    the array, the model, the options and the version. Files are written atomically, and their bytes do not
    depend on the number of workers.

    Parameters
    ----------
    corpus : path
        Folder of sound files, bags, recording folders and logs of snapshots, or a manifest (CSV: path, site,
        detections, odometry).
    out : path
        Folder of the tables ``recordings``, ``approaches``, ``hours`` and optionally ``hops``.
    jobs : int
        Number of processes.
    executor : Executor, optional
        Replaces the processes: an executor of `concurrent.futures`, or Dask's ``client.get_executor()``. Its
        workers need access to the same files and the same folder `out`.
    shard : (int, int)
        Number of this share, from 1, and number of shares, to divide the work among computers without an
        executor.
    hops : bool
        Also write a row per hop, with its snapshot.
    cascade : bool
        Process only the seconds in which the level or coherence of four microphones exceeds the usual value
        of the recording, and those around them. One recording in twenty is processed fully, and the column
        ``kept`` of its approaches gives the recall of the cascade. Not with `hops`.
    on_recording : callable
        Called after each recording, for progress.
    **parts
        Arguments of `open_source`: `car`, `camera`, `miss_rates`, `model`, `context`, `sides`, `budget` or
        `alpha`, `uncalibrated`, `settings`.

    Returns
    -------
    list of HeardShard
        Result of each recording, sorted by name. A recording that failed has a row in ``recordings`` with the
        failure.

    Raises
    ------
    InputFileError
        If there is no recording, or `out` was created with other settings.
    MissingExtraError
        If pyarrow is not installed (extra ``corpus``).

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from tempfile import TemporaryDirectory
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     soundfile.write(f"{folder}/noise.wav", noise, 48_000)
    ...     [hear(folder, f"{folder}/heard")[0].status for run in range(2)]
    ['heard', 'there']
    """
    check_extra("pyarrow")
    if cascade and hops:
        raise InvalidArgumentError("cascade: expected it without hops, because it skips some of them")
    inputs = share_of(find_corpus(Path(corpus).absolute()), *shard)
    plan = HearPlan.begun(Path(out).absolute(), hops, cascade, array, parts)
    former = defaultdict[str, list[Path]](list)
    for path in plan.out.glob(f"*/*-*{PARQUET}"):
        former[path.name.partition("-")[0]].append(path)
    work, shards = partial(process_recording, plan), []
    working = in_processes(work, inputs, jobs) if executor is None else in_executor(executor, work, inputs)
    for one, found in zip(inputs, working, strict=True):
        # Remove the tables of an earlier content of the recording, so that its hours are not added.
        for path in former[one.key]:
            if path.stem != found.shard:
                path.unlink(missing_ok=True)
        shards.append(found)
        on_recording(found)
    return shards


def process_recording(plan: HearPlan, one: CorpusInput) -> HeardShard:
    """Process one recording unless its files exist; its row in ``recordings`` is written last."""
    content, row = "", None
    try:
        content = one.digest()
        if plan.file("recordings", plan.shard(one, content)).exists():
            return HeardShard(one.name, plan.shard(one, content), "there")
        row = _hear(plan, one, content)
    except MissingExtraError:
        raise
    except Exception as error:  # One failure among thousands of recordings becomes a row
        known = isinstance(error, WorldstateError)
        content = content if known else ""
        text = str(error) if known else f"{type(error).__name__}: {error}"
        # Replace the path, so that the text does not depend on the location of the corpus.
        failure = " ".join(text.replace(str(one.path), one.name).split())
        row = HeardRecording(one.name, one.site, content, failure=failure)
    shard = plan.shard(one, content)
    write_table(plan.file("recordings", shard), HeardRecording, [row])
    status = "failed" if row.failure else "heard"
    return HeardShard(one.name, shard, status, row.hops * HOP_S, row.failure)


def _hear(plan: HearPlan, one: CorpusInput, content: str) -> HeardRecording:
    """Process one recording and write its tables; return its row."""
    meter, shard = ApproachMeter(one.name, one.site), plan.shard(one, content)
    if one.path.suffix == LOG_SUFFIX or is_own_mcap(one.path):
        for _, state in read_log(one.path):
            meter.update(state)
    elif plan.card["hops"]:
        write_table(plan.file("hops", shard), HeardHop, _hops(_source(plan, one), meter))
    else:
        source = _source(plan, one)
        kept = kept_seconds(source) if plan.card["cascade"] else None
        sampled = int(one.key, 16) % SAMPLED == 0
        for step in listen_steps(source, None if sampled else kept):
            meter.update(step.state)
        if kept is not None:
            meter.cascaded(kept, sampled)
    write_table(plan.file("approaches", shard), HeardApproach, meter.approaches)
    write_table(plan.file("hours", shard), StateHours, meter.hours())
    return meter.recording(content)


def _hops(source: Source, meter: ApproachMeter) -> Iterator[HeardHop]:
    """Yield the hops of a recording, and update the meter."""
    alarm, denied = getattr(source.sequence, "alarm", None), (source.street or StreetModel()).death
    signature = None if source.model is None else signature_checksum(source.model)
    for step in listen_steps(source):
        meter.update(state := step.state)
        levels = [alarm and alarm_level(state, side, denied, alarm) for side in SIDES]
        columns = hop_stream([step.measurement], name=meter.name).columns
        # Without a reference, vehicles in view are known from detections only.
        heard = {name: columns[name][0].tolist() for name in STREAM_COLUMNS if name != "there"}
        about = meter.name, meter.site, state.risk, state.to_json(), signature
        yield HeardHop(*about, levels[0], levels[1], **heard)


def _source(plan: HearPlan, one: CorpusInput) -> Source:
    model = None if plan.model is None else _model(plan.model)
    given: dict[str, Any] = {"model": model, "detections": one.detections, "odometry": one.odometry}
    return open_source(one.path, plan.array, **given, **plan.others)


@cache
def _model(path: Path) -> Model:
    return read_model(path)


# Measured on ten simulated minutes of a calm street (SB1, seed 5) and ten of a town (TA1, seed 6), with seven
# microphones: these values keep 27 % and 56 % of the seconds, 7 of 7 and 25 of 25 onsets, and the 2 s before
# T0 of 9 of 9 and 32 of 36 vehicles. 2 dB and 0.05 keep 46 % and 68 % of the seconds, the same onsets, and 9
# and 34 vehicles.
LOUDER_DB, MORE_COHERENT, USUAL = 3.0, 0.08, 20.0  # The last is a percentile of the seconds
BEFORE_S, AFTER_S = 3, 2  # A sequence uses 3 s
_MICROPHONES, _BAND_HZ = 4, (150.0, 1500.0)
_FRAME_S = 0.04
# One recording in this many is processed fully, to measure which of its approaches the cascade keeps.
SAMPLED = 20


def kept_seconds(source: Source) -> BoolArray:
    """Return which seconds of a recording a cascade selects, from four of its microphones, shape (n,).

    These are the seconds whose level or coherence exceeds the recording's usual value, the seconds before
    them, which the sequence needs, and those after them.
    """
    told, n_microphones = [], source.array.n_microphones
    with open_sound(source.sound, n_microphones, channels=source.array.channels, strict=False) as audio:
        rate_hz = audio.sample_rate_hz
        nfft = 1 << round(np.log2(_FRAME_S * rate_hz))
        chosen = np.unique(np.linspace(0, audio.channels - 1, _MICROPHONES).round().astype(int))
        stft = StreamingStft(len(chosen), nfft, band_bins(_BAND_HZ, rate_hz, nfft))
        for block in audio.blocks(rate_hz):
            told.append(_level_and_coherence(stft.push(np.ascontiguousarray(block[:, chosen]))))
    marks = np.array(told)
    above = marks - np.percentile(marks, USUAL, axis=0) > (LOUDER_DB, MORE_COHERENT)
    return np.convolve(above.any(axis=1), np.ones(BEFORE_S + AFTER_S + 1))[BEFORE_S:][: len(marks)] > 0.0


def _level_and_coherence(frames: np.ndarray) -> FloatArray:
    r"""Return the level in dB and the mean over bins and pairs of :math:`|S_{mn}| / \sqrt{S_{mm} S_{nn}}`."""
    if not len(frames):  # The last block may be shorter than a frame
        return np.zeros(2)
    cross = np.abs(cross_spectra(frames.transpose(1, 0, 2)))
    powers = np.diagonal(cross, axis1=1, axis2=2)
    first, second = np.triu_indices(frames.shape[2], 1)
    coherence = cross[:, first, second] / np.sqrt(powers[:, first] * powers[:, second] + TINY**2)
    return np.array([10.0 * np.log10(powers.mean() / len(frames) + TINY), coherence.mean()])
