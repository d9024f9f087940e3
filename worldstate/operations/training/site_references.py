"""Feature windows with the reference of their site, taken from other recordings than the scored one."""

from dataclasses import replace

import numpy as np

from worldstate.abduction.signature.site_reference import log_levels, site_reference
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray


def with_site_references(table: FeatureTable, chosen: BoolArray | None = None) -> FeatureTable:
    """Append to each window the reference of its junction.

    Shapes: table (n, 60), chosen (n,), returns (n, 240).
    """
    # No label is looked at, unless the caller chooses windows by their label: a commissioning drive is
    # `chosen=table.hazard_free`.
    levels = log_levels(table.features)
    allowed = np.ones(len(table), dtype=np.bool_) if chosen is None else chosen
    keys = table.recording_keys
    references = np.empty((len(table), 3 * levels.shape[1]))
    for key in np.unique(keys):
        mine = keys == key
        others = (table.environments == table.environments[mine][0]) & ~mine & allowed
        if not others.any():
            raise InvalidArgumentError(
                f"recording {key}: expected another recording of its junction, to compare it with; "
                "method baseline compares with none"
            )
        references[mine] = site_reference(levels[others]).row
    return replace(table, features=np.hstack([table.features, references]))
