"""S_t = {entities, relations, context, cues} as immutable values."""

from .context import Context, Occluder, Priors, Rates, blind_corner
from .cue import RiskCue
from .entity import Classification, Entity, Visibility
from .relation import Relation
from .world_state import Delivery, WorldState

__all__ = [
    "Classification",
    "Context",
    "Delivery",
    "Entity",
    "Occluder",
    "Priors",
    "Rates",
    "Relation",
    "RiskCue",
    "Visibility",
    "WorldState",
    "blind_corner",
]
