r"""Betting tests of the alarm budget and the published chances against later detections of a camera.

Each test has e-values: ratios of an alternative's likelihood to the greatest likelihood that the claim
allows. While the claim holds, their mean is at most one. They restart at a rate :math:`\eta` of the observed
time,

.. math:: M \leftarrow (1 - \eta\, dt)\, M\, e + \eta\, dt,

so that hours of correct values do not hide a new error. M minus :math:`\eta t` is a supermartingale with a
mean of at most one: in any time T, P(M reaches b) is at most :math:`(1 + \eta T) / b` (Ville).

Sources: Shafer, "Testing by betting", J. R. Statist. Soc. A 184, 2021; Shin, Ramdas, Rinaldo, "E-detectors",
2022.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from worldstate.abduction.sequence.sequence_inputs import HOP_S
from worldstate.abduction.sequence.sequence_model import COMING_S, HELD_HOPS, SequenceAlarm
from worldstate.ground import TINY, InvalidArgumentError, nanoseconds, seconds
from worldstate.ground.values import SECONDS_PER_HOUR, replaced
from worldstate.state.cue import Budget, Tally, Verdict

# A vehicle that does not come into view within the risk's horizon was a false alarm. For the same time after
# a vehicle has come into view, the sound may be its own, so an onset is ignored.
HORIZON_NS = nanoseconds(COMING_S[-1])
BET_NS, BET_S = nanoseconds(2.0), 2.0  # The outcome of a two-second chance is known after two seconds
LOOK_NS = nanoseconds(0.5)  # Longest gap between the looks of an unbroken watch
SLACK_NS = nanoseconds(0.05 * HOP_S)  # Tolerance for rounded stamps
# An alarm is held for a second; an alarm after that is a new onset.
ENDS_NS = nanoseconds(HELD_HOPS * HOP_S) + SLACK_NS
_BEGUN_ANEW_HZ = 1.0 / (6.0 * SECONDS_PER_HOUR)
# According to (1 + eta T) / b, a test reaches this with a probability of at most 0.025 in 24 hours.
BROKEN = 200.0
IN_DOUBT = 0.1 * BROKEN
# Onsets come in clusters of up to this size. With a root of this order, the mean of a Poisson ratio is still
# at most one for clusters at random times.
CLUSTER = 2.0
# Alternative rates in budgets: the first is detectable within two hours, the second within minutes
RATES = (2.0, 10.0)
# A chance is accepted if the log-odds of the observed share differ from its own by less than this; the
# alternatives differ by twice as much. Streets differ by a factor of three either way (1.1 nats); the filter
# learns 0.5 nats of this from the traffic.
TOLERANCE_NATS = 0.7


@dataclass(frozen=True, slots=True)
class Evidence:
    """E-values against a claim, one per alternative, and whether they have rejected the claim.

    A rejected claim stays rejected until the mean falls to one, the value before the first bet. The mean is
    capped at `BROKEN`, so that recovery is quick.
    """

    values: tuple[float, ...]
    broken: bool = False

    @property
    def value(self) -> float:
        """The mean of all alternatives, itself an e-value."""
        return math.fsum(self.values) / len(self.values)

    def after(self, factors: Sequence[float], step_s: float) -> "Evidence":
        """Return the evidence after more observed time, with one factor per alternative."""
        anew = -math.expm1(-_BEGUN_ANEW_HZ * step_s)
        values = [(1.0 - anew) * one * e + anew for one, e in zip(self.values, factors, strict=True)]
        mean = math.fsum(values) / len(values)
        kept = min(BROKEN / mean, 1.0)
        return Evidence(tuple(one * kept for one in values), mean >= BROKEN or (self.broken and mean > 1.0))


def onset_factors(onsets: int, step_s: float, onsets_per_hour: float) -> list[float]:
    r"""Return the e-value factors of some false onsets against the claim "at most b onsets per hour".

    .. math:: e_\rho = \big(\rho^n\, e^{-(\rho - 1)\, b\, dt}\big)^{1/c}

    For clusters of at most c onsets the mean is at most one at any rate up to b.
    """
    allowed = onsets_per_hour * step_s / SECONDS_PER_HOUR
    return [math.exp((onsets * math.log(rho) - (rho - 1.0) * allowed) / CLUSTER) for rho in RATES]


def chance_factors(chances: Sequence[float], came: Sequence[bool]) -> list[float]:
    r"""Return the e-value factors of some outcomes against "not too low" and "not too high" chances.

    .. math:: e_\pm = \frac{1}{n} \sum_k \frac{P(y_k \mid p_k^{\pm 2\delta})}{P(y_k \mid p_k^{\pm\delta})},
              \qquad \mathrm{logit}\, p^{d} = \mathrm{logit}\, p + d

    With the tolerance :math:`\delta` the mean is at most one if the true share is within it. Sides may depend
    on one another, so their factors are averaged, not multiplied.
    """
    pairs = list(zip(chances, came, strict=True))
    return [
        math.fsum(_moved(p, 2.0 * d, y) / _moved(p, d, y) for p, y in pairs) / len(pairs)
        for d in (TOLERANCE_NATS, -TOLERANCE_NATS)
    ]


def _moved(chance: float, nats: float, came: bool) -> float:
    """Return the probability of an outcome after a shift of its log-odds."""
    inside = min(max(chance, TINY), 1.0 - TINY)
    up = inside * math.exp(nats)
    return (up if came else 1.0 - inside) / (up + 1.0 - inside)


@dataclass(frozen=True, slots=True)
class WatchedHop:
    """Input of the watch at one hop, with one value per side."""

    stamp_ns: int
    looked: bool  # Whether a camera would have seen a vehicle that comes into view
    over: Sequence[bool]  # Whether the threshold is reached
    emerged_ns: tuple[int | None, ...]  # When a vehicle last came into view
    within: tuple[float, ...]  # P(a vehicle comes into view within two seconds)


_NO_ONSETS, _NO_CHANCES = Evidence((1.0,) * len(RATES)), Evidence((1.0, 1.0))
_MOST = len(RATES) * BROKEN * (1.0 + TINY)  # Limit of one e-value: the whole mean


@dataclass(frozen=True, slots=True)
class BudgetWatch:
    """Watch over an alarm, which reports but changes no threshold."""

    tally: Tally = field(default_factory=Tally)
    onsets: Evidence = _NO_ONSETS
    within: Evidence = _NO_CHANCES
    stamp_ns: int = 0
    since_ns: int | None = None  # Start of the present unbroken series of looks
    pending_ns: tuple[int, ...] = ()  # Onsets whose outcome is still open
    over_ns: tuple[int | None, ...] = (None, None)  # When each side was last above the threshold
    emerged_ns: tuple[int | None, ...] = (None, None)
    bet: tuple[int, tuple[float, ...]] | None = None  # Stamp and chances of the open bet

    def watches(self, stamp_ns: int) -> bool:
        """Return whether a camera has looked without a break until now."""
        return self.since_ns is not None and stamp_ns - self.stamp_ns <= LOOK_NS

    def after(self, hop: WatchedHop, onsets_per_hour: float) -> "BudgetWatch":
        """Return the watch after one more hop."""
        now_ns, watch = hop.stamp_ns, self
        if not (hop.looked and self.watches(now_ns)):
            since_ns = now_ns if hop.looked else None
            watch = replaced(self, since_ns=since_ns, stamp_ns=now_ns, pending_ns=(), bet=None)
        if hop.looked:
            watch = watch._counted(hop, onsets_per_hour)._betted(hop)
        begins = any(hop.over) and all(ns is None or now_ns - ns > ENDS_NS for ns in self.over_ns)
        pending_ns = (*watch.pending_ns, now_ns) if begins else watch.pending_ns
        over_ns = tuple(now_ns if yes else ns for ns, yes in zip(self.over_ns, hop.over, strict=True))
        return replaced(
            watch, stamp_ns=now_ns, emerged_ns=hop.emerged_ns, pending_ns=pending_ns, over_ns=over_ns
        )

    def _counted(self, hop: WatchedHop, onsets_per_hour: float) -> "BudgetWatch":
        """Return the watch with new arrivals, false onsets, and time that is known to be without vehicles."""
        new = [k for k, ns in enumerate(hop.emerged_ns) if ns is not None and ns != self.emerged_ns[k]]
        warned_ns, pending_ns = (self.over_ns[k] for k in new), () if new else self.pending_ns
        known_ns = hop.stamp_ns - HORIZON_NS
        quiet_ns = HORIZON_NS + max(ns for ns in (self.since_ns, *hop.emerged_ns) if ns is not None)
        step_ns = max(known_ns - max(self.stamp_ns - HORIZON_NS, quiet_ns), 0)
        false = sum(quiet_ns <= ns <= known_ns for ns in pending_ns)
        tally = Tally(
            self.tally.quiet_ns + step_ns,
            self.tally.false_onsets + false,
            self.tally.arrivals + len(new),
            self.tally.warned + sum(ns is not None and ns >= known_ns for ns in warned_ns),
        )
        onsets = self.onsets.after(onset_factors(false, seconds(step_ns), onsets_per_hour), seconds(step_ns))
        pending_ns = tuple(ns for ns in pending_ns if ns > known_ns)
        return replaced(self, tally=tally, onsets=onsets, pending_ns=pending_ns)

    def _betted(self, hop: WatchedHop) -> "BudgetWatch":
        """Return the watch after the bet of two seconds ago is settled and the next one is placed."""
        if self.bet is None:
            return replaced(self, bet=(hop.stamp_ns, hop.within))
        laid_ns, chances = self.bet
        if hop.stamp_ns - laid_ns < BET_NS:
            return self
        came = [ns is not None and 0 < ns - laid_ns <= BET_NS for ns in hop.emerged_ns]
        within = self.within.after(chance_factors(chances, came), BET_S)
        return replaced(self, within=within, bet=(hop.stamp_ns, hop.within))

    def check(self, sides: int) -> None:
        """Raise an error for values that no checkpoint can contain."""
        laid = self.emerged_ns if self.bet is None else self.bet[1]
        if {len(self.over_ns), len(self.emerged_ns), len(laid)} != {sides}:
            raise InvalidArgumentError(f"memory.sequence.watch: expected values of {sides} sides")
        for one, first in ((self.onsets, _NO_ONSETS), (self.within, _NO_CHANCES)):
            if len(one.values) != len(first.values) or not all(0.0 < value <= _MOST for value in one.values):
                expected = f"{len(first.values)} e-values up to {_MOST:g}"
                raise InvalidArgumentError(f"memory.sequence.watch: expected {expected}")


def budget_of(watch: BudgetWatch, stamp_ns: int, alarm: SequenceAlarm) -> Budget:
    """Return the published state of an alarm's budget at a time."""
    # Rounded, because full precision takes twice as long to write.
    tests = {"onsets": watch.onsets, "within": watch.within}
    evidence_nats = {name: round(math.log(one.value), 6) for name, one in tests.items()}
    low, high = watch.within.values
    found = {
        "more false onsets than the budget": watch.onsets.broken,
        f"chances within two seconds are too {'low' if low > high else 'high'}": watch.within.broken,
    }
    in_doubt = max(one.value for one in tests.values()) >= IN_DOUBT
    verdict: Verdict = "in doubt" if in_doubt else "kept"
    why = None
    if not watch.watches(stamp_ns):
        verdict, why = "unwatched", "no camera looks where vehicles come into view"
    elif any(found.values()):
        verdict, why = "broken", "; ".join(what for what, is_so in found.items() if is_so)
    asked, promise = alarm.asked_alpha, alarm.promise
    return Budget(verdict, why, evidence_nats, alarm.onsets_per_hour, watch.tally, asked, promise)
