"""Sum of the log-odds of sequence, window and sound levels: a comparison that is not shipped.

The sum has three terms: the log-odds of the shipped sequence model, the larger side ratio of the window, and
a logistic regression over the sequence inputs that are not window evidence. The regression is trained on
simulated streams of two microphones, with the label "a vehicle comes into view within 3 s on this side"; no
real data are used. The spectra of seven microphones have no sound, so the levels come from the path of two
microphones on the same recording.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import COLUMNS, INPUTS, SIDES, sequence_inputs
from worldstate.abduction.sequence.sequence_model import HORIZONS_S, SequenceModel, SequencePosterior
from worldstate.adapters.files.model_file import Model
from worldstate.commissioning.commission import parts_of, stream_evidence, stream_weights
from worldstate.commissioning.guard_training import fit_softmax
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.commissioning.sequence_training import EVERY_HOPS, stream_truth
from worldstate.ground.typing import FloatArray
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate_lab.trials.trial import Trial

from .scores import log_odds, smoothed

# Inputs that are not window evidence: level, loudness, bands, prominence, approach and bearing.
OTHERS = tuple(name for name in INPUTS if not re.search("this|other|lean|visible", name))
_OTHER_INPUTS = [INPUTS.index(name) for name in OTHERS]
# Columns that are measured by a microphone and not contained in spectra.
_LEVELS = [i for i, name in enumerate(COLUMNS) if name == "loudness" or name.startswith("band_")]
COMING_S = 3.0
# Between 0.0002 and 2 the AUROC of the sum one second before T0 changes by 0.01.
STRENGTH = 0.02

Scores = dict[str, list[FloatArray]]


@dataclass(frozen=True, slots=True, eq=False)
class LevelReading:
    """A logistic regression over `OTHERS`: log-odds that a vehicle comes into view within 3 s on a side.

    Examples
    --------
    >>> LevelReading(np.zeros(len(OTHERS)), bias=-2.0, usual=-2.0).log_odds(np.ones((1, len(COLUMNS))))
    array([[-2., -2.]])
    """

    slopes: FloatArray  # shape (35,)
    bias: float
    usual: float  # Log-odds of the mean label of the training data

    @classmethod
    def learned(cls, streams: Sequence[HeardStream], model: Model) -> "LevelReading":
        """Train on every third hop of streams, weighted as in the training of a sequence model."""
        # Window evidence is computed and then left out, so the window model does not affect the training.
        rows = [_others(stream_evidence(parts_of(model)[0], one))[::EVERY_HOPS] for one in streams]
        truths = [stream_truth(one).coming_s[::EVERY_HOPS] <= COMING_S for one in streams]
        weights = np.repeat(stream_weights(streams), [one.size for one in truths])
        inputs = np.concatenate(rows).reshape(-1, len(OTHERS))
        labels = np.concatenate(truths).ravel().astype(np.intp)
        slopes, bias = fit_softmax(inputs, labels, weights, weights, STRENGTH)
        usual = np.average(inputs, axis=0, weights=weights) @ slopes[0] + bias[0]
        return cls(slopes[0], float(bias[0]), float(usual))

    def log_odds(self, columns: FloatArray) -> FloatArray:
        """Return the log-odds of both sides, (n, 13) -> (n, 2); hops without columns have the usual value."""
        return _known(columns, lambda known: _others(known) @ self.slopes + self.bias, self.usual)


def summed_scores(
    seven: Sequence[Trial], pair: Sequence[Trial], reading: LevelReading, model: Model
) -> Scores:
    """Return the sums and their parts at every hop of recordings, each shape (n,), by row name.

    `seven` and `pair` are the same recordings on both paths of `hearing.heard`, `model` is that of the path
    `seven`, and `reading` was trained on simulated streams of the pair. Of the two sides the larger value is
    used. Values are means over 0.3 s, except for rows "one hop" and the published decision value.
    """
    _, sequence = parts_of(model)
    parts = [_parts(*one, reading, sequence) for one in zip(seven, pair, strict=True)]
    return {name: [one[name] for one in parts] for name in parts[0]}


def _parts(
    seven: Trial, pair: Trial, reading: LevelReading, sequence: SequenceModel
) -> dict[str, FloatArray]:
    columns, beside = seven.hops.inputs, _at_hops_of(seven, pair)
    mixed = columns.copy()
    mixed[:, _LEVELS] = beside[:, _LEVELS]
    one, both = (_coming(each, sequence).max(axis=1) for each in (columns, mixed))
    levels, window = reading.log_odds(beside).max(axis=1), _window_nats(seven)
    # A window that the guard rejected is evidence for no side.
    ratio = np.nan_to_num(seven.hops.side_nats).max(axis=1)
    published = seven.hops.compared_nats.max(axis=1)
    terms = {
        "sequence, levels of one channel": one,
        "sequence, levels of both channels": both,
        "side ratio": ratio,
        "window without front": window,
        "logistic": levels,
        "side ratio + logistic": ratio + levels,
        "window without front + logistic": window + levels,
        "sequence + side ratio + logistic": both + ratio + levels,
        "sequence of one channel + side ratio + logistic": one + ratio + levels,
    }
    return {
        "sequence, levels of one channel, one hop": one,
        "sequence, levels of both channels, one hop": both,
        "sequence, as published": published,
        **{name: smoothed(values) for name, values in terms.items()},
        "sequence, as published + side ratio + logistic": published + smoothed(ratio + levels),
    }


def _others(columns: FloatArray) -> FloatArray:
    """Return the inputs that are not window evidence, shape (n, 13) -> (n, 2, 35)."""
    return np.asarray(sequence_inputs(columns)[..., _OTHER_INPUTS])


def _coming(columns: FloatArray, sequence: SequenceModel) -> FloatArray:
    """Return the log-odds of coming into view within 3 s from the sequence alone, shape (n, 2)."""

    def read(posterior: SequencePosterior) -> FloatArray:
        return log_odds(posterior.within()[..., HORIZONS_S.index(COMING_S)])

    usual = read(SequencePosterior(sequence.share[None, None], 0.0))
    return _known(columns, lambda known: read(sequence.posterior(known)), float(usual[0, 0]))


def _known(columns: FloatArray, read: Callable[[FloatArray], FloatArray], usual: float) -> FloatArray:
    """Return the values of the hops that have columns and the usual value at the others, shape (n, 2)."""
    # The guard may reject the first hops of a recording: the history is empty until it accepts one.
    found, known = np.full((len(columns), len(SIDES)), usual), np.isfinite(columns).all(axis=1)
    if known.any():
        found[known] = read(columns[known])
    return found


def _at_hops_of(trial: Trial, other: Trial) -> FloatArray:
    """Return the columns of another path at the hops of a trial; after its end, those of its last hop."""
    # There are 99 spectra for 100 images: the path of two microphones has one hop more.
    at = np.round((trial.hops.time_s - other.hops.time_s[0]) / HOP_S).astype(np.intp)
    return np.asarray(other.hops.inputs[np.clip(at, 0, len(other.hops) - 1)])


def _window_nats(trial: Trial) -> FloatArray:
    """Return the log-odds of a hidden vehicle against none from the window, shape (n,)."""
    left, right, _, none = (trial.hops.shipped + np.log(trial.hops.about["prior"]["shipped"])).T
    return np.asarray(np.logaddexp(left, right) - none)
