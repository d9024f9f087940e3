"""The renderers of a street, by `Site.renderer`."""

import numpy as np

from worldstate.ground.typing import Float32Array
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.presets import Ambience, Preset, recording_ambience, site_ambience

from .background import add_background, add_town
from .mirrors import add_mirrored, town_by_mirrors
from .rays import add_traced, town_by_rays
from .receiver import Receiver

# Functions that carry a point source and the background to the microphones, for drawn walls. All other sites
# use the paths of their plan, for which a vehicle has several points and a late field.
ADD_SOURCE = {"rays": add_traced, "mirrors": add_mirrored}
TOWNS = {"rays": town_by_rays, "mirrors": town_by_mirrors}


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
    if town := TOWNS.get(site.renderer):
        add_town(out, receiver, preset, rng, town(receiver, site, here))
    else:
        add_background(out, receiver, site, preset, rng, here)
