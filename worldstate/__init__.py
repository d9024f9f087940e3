"""A structured world-state, kept alive when a sensor goes blind.

Names are imported when they are first used: importing the package loads nothing. What else there is stands in
`worldstate.state`, `measurement`, `frontend`, `abduction`, `adapters`, `adapters.simulation`, `operations`
and `studies`; a name that none of them exports may change without notice.

Examples
--------
>>> import worldstate
>>> worldstate.WorldFilter().predict(0.1).state.stamp_ns
100000000
"""

import lazy_loader

from worldstate.ground.version import __version__ as __version__

# The stub beside this file lists what is exported and from where.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
