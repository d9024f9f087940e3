"""Update the belief of the sides, and how well a source can hear beside what is in view."""

from collections.abc import Iterable

from worldstate.abduction.co_evidence import Unqueried
from worldstate.belief.street_model import StreetModel
from worldstate.ground import LEAST_HEARD, falling
from worldstate.ground.values import NotUsable, replaced
from worldstate.measurement import CameraLook, Heard, Measurement
from worldstate.state.sensor import MASKED

from .memory import NEWS_HOLDS_NS, Memory
from .site_model import FilterModel
from .street_belief import informed

_JUST_LEFT_NS = 2 * NEWS_HOLDS_NS  # What has left the view is as loud as it was for so long


def heard_beside(memory: Memory, measurement: Measurement, street: StreetModel) -> Heard:
    r"""Return how well could be heard beside a vehicle in view, or one that has just left it.

    .. math:: s = 1 - P(\text{in view})\, \big(1 - P(\text{noticed} \mid \text{level})\big)

    The belief moves by the sequence's own reading, which was learned where vehicles mask one another.
    """
    heard, tracks = measurement.heard, memory.tracks
    near = tracks.moving & (tracks.last_seen_ns >= measurement.stamp_ns - _JUST_LEFT_NS)
    in_view = max(tracks.existence[near].tolist(), default=0.0)
    if memory.belief.has_times:
        in_view = max(in_view, memory.belief.in_view)
    # P(a vehicle that comes into view within three seconds adds a decibel or more to 300 Hz to 2 kHz); with
    # none in view it is 0.8 from 3 dB on.
    quiet = falling(heard.excess_db, (street.excess_low_db, street.excess_high_db))
    share = 1.0 - in_view * (1.0 - 0.5 * quiet)
    # A vehicle that is hardly in view is no reason.
    if in_view < 0.5 or share >= heard.share:
        return heard
    # What masks is heard itself: the ear is not deaf.
    return replaced(heard, share=max(share, LEAST_HEARD), reason=MASKED)


def update_belief(
    memory: Memory, measurement: Measurement, looks: Iterable[CameraLook], model: FilterModel
) -> None:
    """Update the belief of the sides with the evidence of a measurement and with all that cameras saw."""
    said, site, memory.last.predicted = measurement.sequence, model.site, memory.belief.joint.explanations
    seen = [site.in_sight(one) for one in looks if not isinstance(one.look.answer, Unqueried)]
    memory.belief = informed(memory.belief, measurement, seen, model.context, model.policy, site.settings)
    if said is not None:  # Of other sources the last one holds
        memory.last.no_sequence = said if isinstance(said, NotUsable) else None
