"""Update of the belief over the sides, and the audibility of vehicles beside one in view."""

from collections.abc import Iterable

from worldstate.abduction.co_evidence import Unqueried
from worldstate.belief.street_model import StreetModel
from worldstate.ground import LEAST_HEARD, NotUsable, falling, replaced
from worldstate.measurement import CameraLook, Heard, Measurement
from worldstate.state.sensor import MASKED

from .memory import NEWS_HOLDS_NS, Memory
from .site_model import FilterModel
from .street_belief import informed

_JUST_LEFT_NS = 2 * NEWS_HOLDS_NS  # A vehicle that has left the view is as loud as before for this long


def heard_beside(memory: Memory, measurement: Measurement, street: StreetModel) -> Heard:
    r"""Return the audibility of hidden vehicles beside a vehicle that is in view or has just left it.

    .. math:: s = 1 - P(\text{in view})\, \big(1 - P(\text{noticed} \mid \text{level})\big)

    It is only published. The belief uses the sequence model, which was trained on vehicles that mask others.
    """
    heard, tracks = measurement.heard, memory.tracks
    near = tracks.moving & (tracks.last_seen_ns >= measurement.stamp_ns - _JUST_LEFT_NS)
    in_view = max(tracks.existence[near].tolist(), default=0.0)
    if memory.belief.has_times:
        in_view = max(in_view, memory.belief.joint.in_view)
    # P(a vehicle that comes into view within three seconds adds at least 1 dB from 300 Hz to 2 kHz); without
    # a vehicle in view it is 0.8 from 3 dB on.
    quiet = falling(heard.excess_db, (street.excess_low_db, street.excess_high_db))
    share = 1.0 - in_view * (1.0 - 0.5 * quiet)
    # A vehicle that is probably not in view is no reason.
    if in_view < 0.5 or share >= heard.share:
        return heard
    # The masking source itself is audible, so the share is not set below `LEAST_HEARD`.
    return replaced(heard, share=max(share, LEAST_HEARD), reason=MASKED)


def update_belief(
    memory: Memory, measurement: Measurement, looks: Iterable[CameraLook], model: FilterModel
) -> None:
    """Update the belief over the sides with the evidence and the looks of a measurement."""
    said, site, memory.last.predicted = measurement.sequence, model.site, memory.belief.joint.explanations
    seen = [site.in_sight(one) for one in looks if not isinstance(one.look.answer, Unqueried)]
    memory.belief = informed(memory.belief, measurement, seen, model.context, model.policy, site.settings)
    if said is not None:  # Other sources leave it unchanged
        memory.last.no_sequence = said if isinstance(said, NotUsable) else None
