"""How much drives in a stream: arrivals an hour of every flow, and shares of the kinds of vehicles."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from worldstate.ground.checks import in_range, one_of
from worldstate.simulation.scene.kinds import KINDS
from worldstate.simulation.scene.sound_kinds import SIGNALS, SOUNDS

# What a flow is, is drawn in `manoeuvres.py`; these bring vehicles out of a hidden arm.
HAZARDS = ("left", "right", "both", "waits", "queue")
FLOWS = (*HAZARDS, "turns_away", "parks", "far", "from_behind", "from_ahead")
MOST_PER_HOUR = 3600.0
# Cars, delivery vans and lorries, electric cars, bicycles and kick scooters of a side street; assumed, not
# counted.
TOWN_KINDS = {
    **{"light": 0.70, "medium": 0.07, "heavy": 0.03, "electric": 0.08},
    **{"bicycle": 0.10, "scooter": 0.02},
}


@dataclass(frozen=True, slots=True)
class Traffic:
    """Arrivals an hour of every flow, each a Poisson process of its own unless hazards are evenly spaced."""

    name: str
    per_hour: Mapping[str, float]  # Of each of `FLOWS`; those not named never come
    follower_share: float = 0.0  # Probability that a vehicle out of a hidden arm has another one behind it
    evenly: bool = False  # Whether arrivals out of hidden arms take turns instead of meeting by chance
    kinds: Mapping[str, float] = field(default_factory=lambda: TOWN_KINDS)  # Shares, which are normed
    sounds: Mapping[str, float] = field(default_factory=dict)  # What else sounds, by kind, an hour
    signals: Mapping[str, float] = field(default_factory=dict)  # Shares of the vehicles that warn, by signal

    def __post_init__(self) -> None:
        for name, known, most in (
            ("per_hour", FLOWS, MOST_PER_HOUR),
            ("sounds", SOUNDS, MOST_PER_HOUR),
            ("signals", SIGNALS, 1.0),
            ("kinds", KINDS, 1.0),
        ):
            for key, number in getattr(self, name).items():
                one_of(name, key, known)
                in_range(f"{name}[{key!r}]", number, 0.0, most)
        # A share of one would make a queue without an end.
        in_range("follower_share", self.follower_share, 0.0, 0.9)
        in_range("kinds: sum of the shares", sum(self.kinds.values()), 1e-6, 1e6)

    @property
    def hazard_free(self) -> bool:
        """Whether nobody ever comes out of a hidden arm."""
        return not any(self.per_hour.get(flow, 0.0) for flow in HAZARDS)


_OTHERS = {"turns_away": 20.0, "parks": 8.0, "far": 40.0, "from_behind": 12.0, "from_ahead": 12.0}
# A side street at midday and a district road in the rush hour; `no-hazard` is the latter without anyone who
# comes out of a hidden arm: whatever warns there is wrong. `empty` is background alone.
TRAFFICS = {
    traffic.name: traffic
    for traffic in (
        Traffic(
            "calm",
            {"left": 12, "right": 12, "both": 2, "waits": 3, "turns_away": 6, "parks": 3, "far": 15}
            | {"from_behind": 4, "from_ahead": 4},
            follower_share=0.15,
        ),
        Traffic("busy", {"left": 45, "right": 45, "both": 8, "waits": 10} | _OTHERS, follower_share=0.3),
        # One hazard after another, what an exam of approaches asks for: of 36 in 14.4 minutes twenty come
        # alone, ten from both sides at once and six with another one behind them.
        Traffic(
            "approaches",
            {"left": 125 / 3, "right": 125 / 3, "both": 125 / 3, "queue": 25} | _OTHERS,
            evenly=True,
        ),
        Traffic("no-hazard", _OTHERS),
        Traffic("empty", {}),
    )
}


def traffic_named(name: str) -> Traffic:
    """Return a traffic by its name.

    Examples
    --------
    >>> traffic_named("no-hazard").hazard_free, traffic_named("calm").per_hour["both"]
    (True, 2)
    """
    return TRAFFICS[one_of("traffic", name, TRAFFICS)]
