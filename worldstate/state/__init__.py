"""S_t = {entities, relations, context, cues} as immutable values."""

from .context import Context, Occluder, Priors, Rates, blind_corner
from .cue import Advisory, EvidenceTerms, RiskCue
from .entity import Classification, Entity, Visibility
from .event import Event
from .relation import Relation
from .sensor import SearchedView, SensorHealth
from .world_state import Delivery, WorldState, snapshot_schema

__all__ = [
    "Advisory",
    "Classification",
    "Context",
    "Delivery",
    "Entity",
    "Event",
    "EvidenceTerms",
    "Occluder",
    "Priors",
    "Rates",
    "Relation",
    "RiskCue",
    "SearchedView",
    "SensorHealth",
    "Visibility",
    "WorldState",
    "blind_corner",
    "snapshot_schema",
]
