"""Freeze one published quantity at its first value if an environment variable is set.

If no test fails, the quantity is untested; `run_mutations.py --freeze` tries all of them.
"""

import os
from functools import cached_property

import pytest
from published_quantities import held

from worldstate import WorldFilter


@pytest.fixture(scope="session", autouse=True)
def frozen_quantity():
    name, state, first = os.environ.get("WORLDSTATE_FREEZE"), WorldFilter.__dict__["state"], {}
    if name is not None:
        # Without its name the property would not be cached.
        wrapped = cached_property(lambda world: held(state.func(world), name, first))
        wrapped.__set_name__(WorldFilter, "state")
        WorldFilter.state = wrapped
    yield
    WorldFilter.state = state
