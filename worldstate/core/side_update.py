"""Update the belief of the sides: by windows and their looks, or by a sequence."""

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from worldstate.abduction.co_evidence import CoEvidence, Unqueried
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.belief.window_belief import WindowBelief
from worldstate.ground import LEAST_HEARD, FloatArray
from worldstate.ground.values import NotUsable, nanoseconds
from worldstate.measurement import CameraLook, Heard, Measurement

from .memory import Memory
from .sequence_memory import informed
from .site_model import FilterModel


def update_windows(memory: Memory, measurement: Measurement, model: FilterModel) -> None:
    """Update the memory with the signature of a window and its co-evidence."""
    if isinstance(memory.belief, WindowBelief) and measurement.heard.usable:
        source, stamp_ns = measurement.source, measurement.stamp_ns
        window_ns, rates_hz = nanoseconds(model.site.settings.window_s), model.context.rates.values_hz
        looked = log_co_evidence(measurement.co_evidence, len(model.site.sides))
        said = masked_by(measurement.signature, measurement.heard.share)
        handover_ns = [one.handover_ns for one in memory.history]
        signature = _with_hand_overs(said, handover_ns, stamp_ns - window_ns)
        evidence = source, stamp_ns, signature, looked
        memory.belief, prior = memory.belief.update(*evidence, rates_hz, window_ns)
        memory.last.predicted = prior.sides.hypotheses
    else:
        memory.last.predicted = memory.sides.hypotheses


# P(a vehicle that comes into view within three seconds adds a decibel or more to 300 Hz to 2 kHz), by how far
# the sound lies above the place's usual, dB, while another is in view or has left it within two seconds; with
# none in view it is .8 from 3 dB on. 6,066 hops of 28 learned junctions.
_EXCESS_DB, _NOTICED = (4.5, 7.5, 10.5, 13.5, 17.5, 22.0), (0.5, 0.36, 0.33, 0.25, 0.15, 0.06)
_JUST_LEFT_NS = 2_000_000_000  # What has left the view is as loud as it was for so long
_SAID = 0.75  # Above, a vehicle in view is not likely enough to be a reason


def heard_beside(memory: Memory, measurement: Measurement) -> Heard:
    r"""Return how well could be heard beside a vehicle in view, or one that has just left it.

    .. math:: s = 1 - P(\text{in view})\, \big(1 - P(\text{noticed} \mid \text{level})\big)

    The belief moves by the sequence's own reading, which was learned where vehicles mask one another.
    """
    heard, tracks = measurement.heard, memory.tracks
    near = tracks.moving & (tracks.unseen_ns(measurement.stamp_ns) <= _JUST_LEFT_NS)
    in_view = float(tracks.existence[near].max(initial=0.0))
    if memory.sequence is not None:
        in_view = max(in_view, memory.sequence.in_view)
    share = 1.0 - in_view * (1.0 - float(np.interp(heard.excess_db, _EXCESS_DB, _NOTICED)))
    if share >= min(heard.share, _SAID):
        return heard
    # What masks is heard itself: the ear is not deaf.
    return replace(heard, share=max(share, LEAST_HEARD), reason="masked by a vehicle in view")


def masked_by(signature: SignatureEvidence, share: float) -> SignatureEvidence:
    r"""Return the evidence of a window in which a hidden vehicle is noticed with a probability s.

    .. math:: l'_{hid,k} = s\, l_{hid,k} + (1 - s)\, \tfrac{1}{2} (l_{vis} + l_0)

    One that is masked sounds as if it were not there.
    """
    if share >= 1.0:
        return signature
    rest = float(np.logaddexp(signature.visible, signature.none)) + math.log(0.5 * (1.0 - share))
    heard = np.logaddexp(np.array(signature.hidden) + math.log(share), rest)
    return replace(signature, hidden=tuple(heard.tolist()))


def _with_hand_overs(
    signature: SignatureEvidence, handover_ns: Iterable[int | None], begin_ns: int
) -> SignatureEvidence:
    """Return the evidence, its visible likelihood at least the hidden one for a window after a hand-over."""
    # A window that begins before a hand-over holds sound of the vehicle while it was hidden; without this,
    # that sound would give birth to a second hidden entity.
    pairs = zip(signature.hidden, handover_ns, strict=True)
    before = [hidden for hidden, stamp_ns in pairs if stamp_ns is not None and stamp_ns > begin_ns]
    # At least, not equal: what already sounds like a source in view stays that.
    return replace(signature, visible=max([signature.visible, *before])) if before else signature


def log_co_evidence(answer: CoEvidence, directions: int) -> FloatArray:
    """Return log p(V | hidden_1 .. hidden_K, visible, none), shape (K + 2,), nats."""
    hidden, visible, none = answer.log_likelihoods().tolist()
    return np.array([*[hidden] * directions, visible, none])


def update_sequence(
    memory: Memory, measurement: Measurement, looks: Iterable[CameraLook], model: FilterModel
) -> None:
    """Update the memory with what a sequence model and the cameras say of vehicles that come into view."""
    said, site = measurement.sequence, model.site
    told = [site.in_sight(one) for one in looks if not isinstance(one.look.answer, Unqueried)]
    memory.belief = informed(memory.sequence, measurement, told, model.context) or memory.belief
    if said is not None:  # Other sources do not speak of it: what was said last holds
        memory.last.no_sequence = said if isinstance(said, NotUsable) else None
