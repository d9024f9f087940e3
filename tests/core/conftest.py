"""Hold one published quantity at the first value it had, where an environment variable names it.

One that may be held so without any test noticing is read by users and guarded by nobody:
`run_mutations.py --freeze` tries them all.
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
        # Under another name the property would be computed at every reading.
        wrapped = cached_property(lambda world: held(state.func(world), name, first))
        wrapped.__set_name__(WorldFilter, "state")
        WorldFilter.state = wrapped
    yield
    WorldFilter.state = state
