"""Settings of the filter."""

import math
import warnings
from dataclasses import InitVar, dataclass, field
from typing import Any, Literal

from worldstate.ground.checks import in_range, one_of
from worldstate.ground.values import replaced

from .street_model import StoredStreet, StreetModel

# Fields of the street model, in the order of the arguments of 0.3; one value ends seen and heard entities.
_FORMER = ("look_s", "birth", "death", "death")


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """Settings of a filter, apart from its context and its policy.

    Parameters
    ----------
    window_s : float
        Length of the window of a signature, s. Overlapping windows share most of their samples: a bearing
        or approach rate has the weight kappa = (time since the last one) / window, at most 1.
    street : StreetModel
        Parameters of the belief.
    windows : {"posterior", "likelihood"}
        How a window enters if no sequence model interprets it: by the new part of its posterior, or by
        its likelihoods, weighted with the new share of the window.
    stream : str
        Name from which entity ids are derived; the same stream gives the same ids.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> FilterSettings(stream="drive").window_s
    1.0
    """

    window_s: float = 1.0  # Length for the published feature
    # Arguments of 0.3, in its order; for one minor version they set numbers of the street model.
    look_interval_s: InitVar[float | None] = None
    birth_probability: InitVar[float | None] = None
    death_probability: InitVar[float | None] = None
    delete_existence: InitVar[float | None] = None
    stream: str = "worldstate"
    street: StoredStreet = field(default_factory=StreetModel)
    windows: Literal["posterior", "likelihood"] = "posterior"

    def __post_init__(self, *former: float | None) -> None:
        given = [one for one in zip(_FORMER, former, strict=True) if one[1] is not None]
        if given:
            changed: dict[str, Any] = dict(reversed(given))  # `death_probability` has precedence
            names = ", ".join(sorted(changed))
            warnings.warn(f"give {names} to StreetModel, as FilterSettings.street", DeprecationWarning, 3)
            object.__setattr__(self, "street", replaced(self.street, **changed))
        in_range("window_s", self.window_s, 0.0, math.inf, open_low=True)
        one_of("windows", self.windows, ("posterior", "likelihood"))
