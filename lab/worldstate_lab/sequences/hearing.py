"""The full chain on a recording of a street corner, as a trial on which methods are scored.

There are two paths. On the path `seven`, spectra of seven microphones and one channel of sound replace the
array of the shipped model. On the path `pair`, the full chain runs on two channels with a model made for
them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import COLUMNS, SIDES
from worldstate.abduction.sequence.sequence_model import GROUPS
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.adapters.camera.detections import DetectionLog
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.files.array_file import read_array
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.adapters.listener import Listener, Step
from worldstate.adapters.source import ListenSettings, Source, open_source
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground.typing import FloatArray
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.passes.followed_stream import chances, cues_of
from worldstate_lab.trials.listening import (
    box_table,
    columns_of,
    filtered_decisions,
    tables_of_steps,
    unfiltered_decisions,
    widest_moving,
    with_scores,
)
from worldstate_lab.trials.pass_cache import ALPHA
from worldstate_lab.trials.trial import TRUTH_COLUMNS, Trial

from .recordings import NANODET_BOXES, CornerRecording

PathName = Literal["seven", "seven_on_time", "pair"]
SPECTRA: tuple[PathName, ...] = ("seven", "seven_on_time")
PAIR = Path("pair")
# Published values of each hop, some by side.
PRODUCT_COLUMNS = (
    "compared_nats",  # shape (2,): Value that the alarm of a side compares with its threshold
    "risk",  # shape (2,)
    "within",  # shape (2, 4): Chances of coming into view by horizon; NaN without a sequence posterior
    "hypotheses",  # shape (3,): Hidden, visible, none
    "advised",  # shape (2,)
    # shape (2,): Log ratio of a vehicle hidden on a side to none or one in view, from the window
    "side_nats",
    "groups",  # shape (2, groups): Posterior of the sequence alone; NaN without a sequence model
    "inputs",  # shape (13,): Inputs of the sequence model at this hop
)
_LEAST_NATS = -20.0  # Used before a value is available


_SETTINGS = ListenSettings(boxes=NANODET_BOXES)
_NO_READING = np.full((len(SIDES), len(GROUPS)), np.nan)


@dataclass(frozen=True, slots=True)
class Chain:
    """One configuration in which the full chain runs over recordings.

    Parameters
    ----------
    path : {"seven", "seven_on_time", "pair"}
        Source of the sound; see `CornerRecording.spectra` for the two ways to read spectra.
    model : Model
        Model made for this source; for spectra, the shipped model.
    array : MicrophoneArray
        Array of the model.
    boxes : str or None
        Folder of the boxes beside the sound; None for no camera.
    miss_rates : MissRates, optional
        Miss rates of the detector; by default those of the library.
    degradation : float
        d of the camera, if known.
    settings : ListenSettings
        Settings of the listener.
    image_step : int
        2 withholds every second image of the camera.
    """

    path: PathName
    model: Model
    array: MicrophoneArray
    boxes: str | None = "boxes"
    miss_rates: MissRates | None = None
    degradation: float = 0.0
    settings: ListenSettings = _SETTINGS
    image_step: int = 1

    def source(self, recording: CornerRecording) -> Source:
        """Return the recording with its model and its camera."""
        source = open_source(
            recording.sound if self.path == "pair" else "spectra",
            array=self.array,
            detections=None if self.boxes is None else recording.boxes(self.boxes),
            camera=PinholeCamera.ovad(),
            miss_rates=self.miss_rates,
            model=self.model,
            settings=self.settings,
        )
        log, step = source.detections, self.image_step
        if log is not None:
            log = DetectionLog(log.frames[::step], log.stamps_ns[::step], log.source)
        return replace(source, degradation=self.degradation, detections=log)

    def steps(self, recording: CornerRecording) -> Iterator[Step]:
        """Yield every hop of a recording."""
        sound, rate_hz = recording.samples()
        source = self.source(recording)
        if self.path == "pair":
            yield from Listener(source, rate_hz).steps(sound)
        else:
            spectra = recording.spectra(self.path == "seven_on_time")
            yield from Listener(source, rate_hz, spectra=spectra).steps(sound[:, :1])


def corner_chain(path: PathName, folder: Path, model: Path | None, boxes: str | None) -> Chain:
    """Return a path over the recordings in a folder, by default with the pair's model or the shipped one."""
    if path in SPECTRA:
        return ovad_chain(read_model(model), boxes, path)
    pair = folder / PAIR
    return Chain(path, read_model(model or pair / "model.json"), read_array(pair / "array.csv"), boxes)


def ovad_chain(model: Model, boxes: str | None = "boxes", path: PathName = "seven") -> Chain:
    """Return a path over spectra with a model for OVAD's array."""
    return Chain(path, model, ovad_array(), boxes)


def heard(chain: Chain, recording: CornerRecording) -> Trial:
    """Return a recording processed by the full chain, as a trial.

    In addition to the fields of every trial, `chains["filtered"].tracks` contains the tracks of the filter,
    and its hops contain `PRODUCT_COLUMNS`.
    """
    source, steps = chain.source(recording), list(chain.steps(recording))
    vision = source.camera_channel()
    boxes = box_table(source, vision)
    said = tables_of_steps(recording.name, steps)
    product = HopTable.of_rows(PRODUCT_COLUMNS, map(_product_row, steps)).columns
    frames = [one.frame for one in steps]
    about = {"site": recording.junction, "moving": False, "camera": chain.boxes is not None}
    t0_s = np.nan if recording.hazard_free else recording.t0_s
    hops = HopTable(
        {
            **columns_of(said["stream"], frames, vision),
            **product,
            "bearing_std_rad": np.array([frame.bearing_std_rad for frame in frames]),
        },
        *(recording.name, recording.side, t0_s, about),
    )
    truth = HopTable.of_rows(TRUTH_COLUMNS, [] if recording.hazard_free else widest_moving(boxes))
    policy = chain.model.policies.for_alpha(ALPHA)
    chains = {"shipped": unfiltered_decisions(said, policy), "filtered": filtered_decisions(said)}
    return Trial(with_scores(hops, said["stream"], chain.model), boxes, truth, chains)


def _product_row(step: Step) -> tuple[FloatArray, ...]:
    state, measured = step.state, step.measurement
    cues = cues_of(state)
    sides, reading = measured.signature.sides, measured.sequence
    history = step.checkpoint.history
    priors = cues[0].hypotheses
    assert priors is not None  # The source has a model here
    return (
        np.array([_LEAST_NATS if one.evidence is None else one.evidence.compared_nats for one in cues]),
        np.array([one.risk for one in cues]),
        np.array([chances(one) for one in cues]),
        np.array([priors.hidden, priors.visible, priors.none]),
        np.array([one.advisory is not None for one in cues]),
        np.full(len(SIDES), np.nan) if sides is None else np.array(sides.log_ratios),
        reading.groups if isinstance(reading, SequenceReading) else _NO_READING,
        history.recent[-1] if history is not None and history.hops else np.full(len(COLUMNS), np.nan),
    )
