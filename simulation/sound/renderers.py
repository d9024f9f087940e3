"""The renderers of a street, by `Site.renderer`."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import Float32Array
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.presets import Ambience, Preset, recording_ambience, site_ambience

from .background import Town, add_background, add_town
from .mirrors import add_mirrored, town_by_mirrors
from .rays import add_traced, town_by_rays
from .receiver import Receiver
from .static_field import PlacedSource, StreetSound


@dataclass(frozen=True, slots=True)
class Renderer:
    """Functions that carry a point source and the background to the microphones, for drawn walls."""

    add_source: Callable[[StreetSound, PlacedSource, np.random.Generator], None]
    town: Callable[[Receiver, Site, Ambience], Town]
    over_roofs: bool  # Whether it also renders sources outside both streets


# All other sites use the paths of their plan, for which a vehicle has several points and a late field.
RENDERERS = {
    "rays": Renderer(add_traced, town_by_rays, over_roofs=True),
    "mirrors": Renderer(add_mirrored, town_by_mirrors, over_roofs=False),
}


def add_ambience(
    out: Float32Array,
    receiver: Receiver,
    site: Site,
    preset: Preset,
    rng: np.random.Generator,
    here: Ambience | None = None,
) -> None:
    """Add the background of a street without a vehicle; the recording's ambience is drawn unless given."""
    here = here or recording_ambience(site_ambience(site, preset), preset, rng)
    if renderer := RENDERERS.get(site.renderer):
        add_town(out, receiver, preset, rng, renderer.town(receiver, site, here))
    else:
        add_background(out, receiver, site, preset, rng, here)
