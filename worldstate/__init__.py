"""A structured world-state that remains available when a sensor fails.

Importing the package loads nothing; each name is imported at its first use. The packages `abduction`,
`adapters`, `frontend`, `measurement`, `operations`, `simulation`, `smoothing` and `state` export more names.
A name that no package exports may change without notice.

Examples
--------
>>> import worldstate
>>> worldstate.WorldFilter().predict(0.1).state
0.1 s  no measurement yet
"""

from importlib import import_module
from warnings import warn

import lazy_loader

from worldstate.ground.version import __version__ as __version__

# The stub beside this file lists each exported name with its module.
_exported, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Names that 0.3 exported from here, with the package that exports them: they are removed in 0.5.
_FORMER = {
    "AcousticAdapter": "adapters",
    "Approach": "measurement",
    "Bearing": "measurement",
    "Checkpoint": "adapters",
    "CoEvidenceChannel": "measurement",
    "Entity": "state",
    "Position": "measurement",
    "PositionScan": "measurement",
    "corner_at": "state",
    "uncalibrated_policy": "abduction",
}


def __getattr__(name: str) -> object:
    if name not in _FORMER:
        return _exported(name)
    package = f"{__name__}.{_FORMER[name]}"
    warn(f"worldstate.{name} is {package}.{name}", DeprecationWarning, stacklevel=2)
    return getattr(import_module(package), name)
