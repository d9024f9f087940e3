"""What was heard of a street while a camera watched it, and of it what belongs to single passes."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.sequence.sequence_model import SequenceModel
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.abduction.sequence.street_sides import PassSound, arrival_pattern, somebody_comes
from worldstate.adapters.files.acoustic_domain import heard_with
from worldstate.adapters.files.model_file import Model
from worldstate.adapters.listen import Source, measure_steps, open_source
from worldstate.ground.errors import OutOfDomainError
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable, seconds

from .pass_labels import PassLabel

# Before T0; a vehicle is heard for some three seconds.
_HEARD_S = 3.0

_UNHEARD = "what the arms sound like is not learned: %s"
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class HeardStreet:
    """How sound arrived at every hop, and how likely a vehicle was coming."""

    time_s: FloatArray  # shape (n,)
    patterns: FloatArray  # shape (n, 12), as `arrival_pattern`
    coming: FloatArray  # shape (n,)
    heard_by: str

    def before(self, one: PassLabel, every: Sequence[PassLabel]) -> PassSound | None:
        """Return how a pass sounded while it was hidden; None where another one came out of the other arm."""
        t0_s = one.t0.time_s
        if any(other.arm != one.arm and abs(other.t0.time_s - t0_s) < _HEARD_S for other in every):
            return None
        hidden = (self.time_s >= t0_s - _HEARD_S) & (self.time_s < t0_s)
        if not hidden.any():
            return None
        return PassSound(self.patterns[hidden], self.coming[hidden], self.heard_by)


def heard_street(source: Source, model: Model) -> HeardStreet | None:
    """Listen to a whole recording with a model; None, and a warning why, where it was not made for the sound.

    Hops without a sequence's reading are left out.
    """
    try:
        listened = open_source(source.sound, array=source.array, model=model)
    except OutOfDomainError as error:
        _LOG.warning(_UNHEARD, error)
        return None
    if model.domain is None or not isinstance(listened.sequence, SequenceModel):
        told = listened.sequence
        _LOG.warning(_UNHEARD, told.reason if isinstance(told, NotUsable) else "the model names no array")
        return None
    read = [
        (seconds(frame.stamp_ns), frame.feature, measured.sequence.groups)
        for frame, measured in measure_steps(listened)
        if isinstance(measured.sequence, SequenceReading)
    ]
    if not read:
        _LOG.warning(_UNHEARD, "the recording is too short")
        return None
    time_s, features, groups = map(np.array, zip(*read, strict=True))
    return HeardStreet(time_s, arrival_pattern(features), somebody_comes(groups), heard_with(model.domain))
