"""Site model of the filter: the context as seen from the ego vehicle's present pose."""

import math
from dataclasses import dataclass

from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.evidence import MOST_NATS
from worldstate.belief.kinematics.cartesian import EgoBelief
from worldstate.belief.site_geometry import SideGeometry, SiteGeometry
from worldstate.belief.street_model import FilterSettings
from worldstate.ground.values import replaced
from worldstate.measurement import Measurement
from worldstate.state import Context
from worldstate.state.context import seen_from


@dataclass(frozen=True, slots=True)
class FilterModel:
    """Context, policy and site geometry, constant while the filter runs."""

    context: Context
    policy: CueingPolicy
    site: SiteGeometry
    reads_sound: bool = True  # Whether a model interprets the sound


def site_geometry_of(
    context: Context, settings: FilterSettings, ego: EgoBelief | None = None
) -> SiteGeometry:
    """Return the site geometry of a context, as seen from the ego vehicle."""
    x, y, yaw_rad = (0.0, 0.0, 0.0) if ego is None else ego.pose.tolist()
    sides = (
        SideGeometry(
            one.direction,
            one.edge_azimuth_rad,
            one.hidden_azimuth_rad,
            one.hidden_std_rad,
            one.edge_std_rad,
            one.pace_hz,
            one.hides,
            0.0 if one.corner_m is None else yaw_rad,
            None if one.corner_m is None else math.dist(one.corner_m, (x, y)),
            settings.street.assumed_certainty if one.assumed else 1.0,
            0.0 if one.corner_m is None else abs(one.corner_m[1] - y),
            settings.street,
        )
        for one in context.occluders
    )
    twist = (context.ego_speed_mps or 0.0, 0.0) if ego is None else (ego.speed_mps, ego.yaw_rate_rad_s)
    return SiteGeometry(tuple(sides), context.view_half_angle_rad, settings, *twist)


def from_here(model: FilterModel, ego: EgoBelief | None) -> FilterModel:
    """Return the model as seen from the ego vehicle's present pose; without odometry, the model itself."""
    if ego is None:
        return model
    x_var, y_var, yaw_var = ego.covariance.diagonal().tolist()
    stds = math.sqrt(0.5 * (x_var + y_var)), math.sqrt(yaw_var)
    x, y, yaw = ego.pose.tolist()
    occluders = tuple(seen_from(one, (x, y, yaw), *stds) for one in model.context.occluders)
    context = replaced(model.context, occluders=occluders, ego_speed_mps=ego.speed_mps)
    return replaced(model, context=context, site=site_geometry_of(context, model.site.settings, ego))


def without_open_sides(measurement: Measurement, context: Context) -> Measurement:
    """Remove a window's evidence for vehicles hidden on sides without an occluder."""
    if all(one.hides for one in context.occluders):
        return measurement
    is_open = {one.direction for one in context.occluders if not one.hides}
    said = measurement.signature
    pairs = zip(said.directions, said.hidden, strict=True)
    hidden = tuple(-MOST_NATS if side in is_open else nats for side, nats in pairs)
    return replaced(measurement, signature=replaced(said, hidden=hidden))
