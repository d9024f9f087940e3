"""Settings of the filter, and parameters of its belief, each with a symbol, a unit and a source in a file."""

import json
import math
import warnings
from collections.abc import Mapping
from dataclasses import InitVar, dataclass, field
from importlib.resources import files
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from worldstate.ground import InvalidArgumentError, in_range, replaced
from worldstate.ground.checks import one_of
from worldstate.ground.serialisation import Layout, Via, decode


@dataclass(frozen=True, slots=True)
class Number:
    """A number of a street model and its origin."""

    value: float
    symbol: str
    unit: str
    origin: Literal["fitted", "measured", "assumed", "given"]
    why: str  # Reason for the value


@dataclass(frozen=True, slots=True)
class StreetNumbers:
    """The numbers of a street model by name, as in a file."""

    LAYOUT: ClassVar = Layout("worldstate.StreetModel", "1.0.0")

    numbers: Mapping[str, Number]


_SHIPPED = decode(
    StreetNumbers, json.loads((files("worldstate") / "data/street_model.json").read_text()), "street_model"
)


def shipped_number(name: str) -> Any:
    """Return a dataclass field whose default is the number in the shipped model."""
    return field(default=_SHIPPED.numbers[name].value)


@dataclass(frozen=True, slots=True)
class StreetModel:
    """Parameters of the belief over the approach sides; the defaults are those of the shipped model.

    `described` contains the symbol, unit and reason of each number, and its origin: fitted, measured, assumed
    or given by the caller.

    Raises
    ------
    InvalidArgumentError
        If a number is not positive, or not finite.

    Examples
    --------
    >>> street = StreetModel(look_s=1.0)
    >>> [(one.value, one.origin) for one in (street.described["look_s"], street.described["works"])]
    [(1.0, 'given'), (0.98, 'assumed')]
    """

    passage_s: float = shipped_number("passage_s")
    arrival_s: float = shipped_number("arrival_s")
    far_s: float = shipped_number("far_s")
    leak: float = shipped_number("leak")
    reading_s: float = shipped_number("reading_s")
    reading_gain: float = shipped_number("reading_gain")
    by_sound: float = shipped_number("by_sound")
    window_s: float = shipped_number("window_s")
    look_s: float = shipped_number("look_s")
    works: float = shipped_number("works")
    fails_s: float = shipped_number("fails_s")
    recovers_s: float = shipped_number("recovers_s")
    unheard: float = shipped_number("unheard")
    follows: float = shipped_number("follows")
    follows_s: float = shipped_number("follows_s")
    traffic_like: float = shipped_number("traffic_like")
    traffic_s: float = shipped_number("traffic_s")
    traffic_nats: float = shipped_number("traffic_nats")
    beside_s: float = shipped_number("beside_s")
    beside_nats: float = shipped_number("beside_nats")
    masked_s: float = shipped_number("masked_s")
    death: float = shipped_number("death")
    births: float = shipped_number("births")
    clutter: float = shipped_number("clutter")
    assumed_certainty: float = shipped_number("assumed_certainty")
    hidden_return: float = shipped_number("hidden_return")
    width_change: float = shipped_number("width_change")
    size_spread: float = shipped_number("size_spread")
    misread: float = shipped_number("misread")
    side_confusion: float = shipped_number("side_confusion")
    doubt: float = shipped_number("doubt")
    edge_std_rad: float = shipped_number("edge_std_rad")
    range_m: float = shipped_number("range_m")
    range_spread: float = shipped_number("range_spread")
    closing_hz: float = shipped_number("closing_hz")
    acceleration: float = shipped_number("acceleration")
    unseen_s: float = shipped_number("unseen_s")
    known_m: float = shipped_number("known_m")
    speed_mps: float = shipped_number("speed_mps")
    label_gain: float = shipped_number("label_gain")
    heard_path: float = shipped_number("heard_path")
    heard_std_rad: float = shipped_number("heard_std_rad")
    seen_path: float = shipped_number("seen_path")
    seen_std_rad: float = shipped_number("seen_std_rad")
    bearing_s: float = shipped_number("bearing_s")
    extent_rad: float = shipped_number("extent_rad")
    past_std_rad: float = shipped_number("past_std_rad")
    birth: float = shipped_number("birth")
    turn_share: float = shipped_number("turn_share")
    excess_low_db: float = shipped_number("excess_low_db")
    excess_high_db: float = shipped_number("excess_high_db")
    sources: StreetNumbers = field(default=_SHIPPED, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in _SHIPPED.numbers:
            in_range(name, getattr(self, name), 0.0, 1e6, open_low=True)

    @property
    def described(self) -> dict[str, Number]:
        """Every number with its origin, by name."""
        pairs = ((name, one, getattr(self, name)) for name, one in self.sources.numbers.items())
        given = "given by the caller"
        return {
            name: one if one.value == now else replaced(one, value=now, origin="given", why=given)
            for name, one, now in pairs
        }

    @classmethod
    def of(cls, stored: StreetNumbers) -> "StreetModel":
        """Return the model of a file; numbers that are missing there have the shipped values."""
        told = {name: one for name, one in stored.numbers.items() if name in _SHIPPED.numbers}
        for name, one in told.items():
            if one.unit != (unit := _SHIPPED.numbers[name].unit):
                raise InvalidArgumentError(f"{name}: expected a number in {unit!r}, got {one.unit!r:.40}")
        values = {name: one.value for name, one in told.items()}
        return cls(**values, sources=StreetNumbers({**_SHIPPED.numbers, **told}))


# A street model in files and checkpoints.
_STORED = Via(StreetNumbers, lambda street: StreetNumbers(street.described), StreetModel.of)
StoredStreet: TypeAlias = Annotated[StreetModel, _STORED]

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
