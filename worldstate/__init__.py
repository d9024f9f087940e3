"""A structured world-state, kept alive when a sensor goes blind."""

from worldstate.belief.settings import FilterSettings
from worldstate.core.filter import WorldFilter
from worldstate.measurement.measurement import Approach, Bearing, Measurement, Sighting
from worldstate.state import Context, Entity, Relation, RiskCue, WorldState

__all__ = [
    "Approach",
    "Bearing",
    "Context",
    "Entity",
    "FilterSettings",
    "Measurement",
    "Relation",
    "RiskCue",
    "Sighting",
    "WorldFilter",
    "WorldState",
]
