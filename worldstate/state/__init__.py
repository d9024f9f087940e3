"""S_t = {entities, relations, context, cues} as immutable values."""

from worldstate.ground.reading import Record, check_schema

from .context import Context, Occluder, Priors, Rates, blind_corner
from .cue import RiskCue
from .entity import ANSWERS, Classification, Entity, Visibility
from .relation import EGO, Relation
from .world_state import SCHEMA_NAME, SCHEMA_VERSION, WorldState

__all__ = [
    "ANSWERS",
    "EGO",
    "SCHEMA_NAME",
    "SCHEMA_VERSION",
    "Classification",
    "Context",
    "Entity",
    "Occluder",
    "Priors",
    "Rates",
    "Record",
    "Relation",
    "RiskCue",
    "Visibility",
    "WorldState",
    "blind_corner",
    "check_schema",
]
