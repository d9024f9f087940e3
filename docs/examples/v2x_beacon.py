"""A second modality: cooperative V2X beacons, heard round the corner and checked against the camera.

A vehicle that is equipped says ten times a second where it is and how fast it drives. The radio carries round
a corner, but the corner costs power; and anybody can claim anything. So a beacon plays the part that sound
plays elsewhere: its signature is the received power against what the claimed range would give, its
co-evidence is the object that the camera should see where the beacon says that it is. Nothing in `abduction`
knows of radio: it is given log-likelihoods and an answer.

Windows of sound repeat one another, and the filter takes what is new in their posterior. Every beacon has an
error of its own once the vehicle has moved on by some metres, so that beacons are multiplied instead.

Run it:

    python docs/examples/v2x_beacon.py
"""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

from worldstate import (
    Absent,
    FilterSettings,
    Measurement,
    NotUsable,
    Present,
    Sighting,
    SignatureEvidence,
    Unqueried,
    WorldFilter,
    WorldState,
    nanoseconds,
)
from worldstate.abduction import uncalibrated_policy
from worldstate.measurement import Approach, Bearing, CoEvidenceChannel

DIRECTIONS = ("left", "right")
# Assumed: shadowing repeats for 0.3 s, 2 m at the pace of a side street.
SETTINGS = FilterSettings(windows="likelihood", window_s=0.3)

# What each kind of station should look like to a camera; a person in a car park need not be seen at all.
EXPECTED_LABELS: dict[str, Collection[str]] = {
    "passenger car": {"car"},
    "truck": {"truck", "bus"},
    "motorcycle": {"motorcycle"},
    "pedestrian": (),
}


@dataclass(frozen=True, slots=True)
class Beacon:
    """One cooperative message, in `base_link`, with the power that it arrived with.

    Parameters
    ----------
    stamp_ns : int
        On the stream's clock.
    x_m, y_m : float
        Claimed position.
    vx_m_s, vy_m_s : float
        Claimed velocity.
    power_dbm : float
        Received power.
    station : str
        Claimed kind of station.
    """

    stamp_ns: int
    x_m: float
    y_m: float
    vx_m_s: float
    vy_m_s: float
    power_dbm: float
    station: str = "passenger car"

    @property
    def range_m(self) -> float:
        """Claimed distance."""
        return math.hypot(self.x_m, self.y_m)

    @property
    def azimuth_rad(self) -> float:
        """Claimed azimuth, left positive."""
        return math.atan2(self.y_m, self.x_m)


@dataclass(frozen=True, slots=True)
class RadioSignature:
    """Likelihood of a beacon under every explanation.

    The excess loss over free space is Gaussian: about `corner_loss_db` behind a corner, about zero in plain
    view. Without a vehicle the beacon is a ghost, replayed or forged: its power goes with its claim only by
    chance and spreads over `ghost_range_db`, its azimuth over the half-plane ahead. The claimed azimuth of a
    vehicle is that of an occluded approach, or of the view. How rare ghosts are is a matter of the context's
    rates and not of any one beacon.
    """

    transmit_dbm: float = 23.0
    loss_at_1_m_db: float = 47.9
    corner_loss_db: float = 17.0
    loss_std_db: float = 5.0
    ghost_range_db: float = 30.0
    hidden_azimuth_rad: float = 0.96
    hidden_std_rad: float = 0.35
    view_half_angle_rad: float = 0.62

    def evidence(self, beacon: Beacon) -> SignatureEvidence:
        """Return log-likelihoods of one beacon, nats."""
        loss_db = self.transmit_dbm - beacon.power_dbm
        excess_db = loss_db - self.loss_at_1_m_db - 20.0 * math.log10(max(beacon.range_m, 1.0))
        behind = _log_gaussian(excess_db, self.corner_loss_db, self.loss_std_db)
        open_air = _log_gaussian(excess_db, 0.0, self.loss_std_db)
        azimuth = beacon.azimuth_rad
        in_view = abs(azimuth) <= self.view_half_angle_rad
        return SignatureEvidence(
            DIRECTIONS,
            hidden=(
                behind + _log_gaussian(azimuth, self.hidden_azimuth_rad, self.hidden_std_rad),
                behind + _log_gaussian(azimuth, -self.hidden_azimuth_rad, self.hidden_std_rad),
            ),
            visible=open_air - math.log(2.0 * self.view_half_angle_rad) - (0.0 if in_view else 10.0),
            none=-math.log(self.ghost_range_db * math.pi),
        )


class BeaconAdapter:
    """Turns beacons into measurements; a `MeasurementAdapter` of lists of beacons.

    Parameters
    ----------
    signature : RadioSignature, optional
        How radio behaves here.
    vision : CoEvidenceChannel, optional
        Asked where the beacon says that its sender is.
    """

    def __init__(
        self, signature: RadioSignature | None = None, vision: CoEvidenceChannel | None = None
    ) -> None:
        self.source = "v2x"
        self._signature = signature or RadioSignature()
        self._vision = vision

    def measure(self, beacons: list[Beacon], /) -> list[Measurement]:
        """Return a measurement a beacon, oldest first."""
        return [self._interpret(beacon) for beacon in sorted(beacons, key=lambda beacon: beacon.stamp_ns)]

    def _interpret(self, beacon: Beacon) -> Measurement:
        # Two metres of positioning error at the claimed range.
        bearing = Bearing(beacon.azimuth_rad, math.atan2(2.0, max(beacon.range_m, 2.0)))
        sightings = self._vision.sightings(beacon.stamp_ns) if self._vision else ()
        return Measurement(
            stamp_ns=beacon.stamp_ns,
            signature=self._signature.evidence(beacon),
            co_evidence=self._ask(beacon, bearing),
            bearing=bearing,
            approach=_approach(beacon),
            sightings=sightings,
            source=self.source,
        )

    def _ask(self, beacon: Beacon, bearing: Bearing) -> Absent | Present | Unqueried:
        expected = EXPECTED_LABELS.get(beacon.station, ())
        if self._vision is None or not expected:
            return Unqueried("no camera, or nothing that it should see")
        return self._vision.ask(beacon.stamp_ns, bearing, expected)


def _approach(beacon: Beacon) -> Approach | NotUsable:
    if beacon.range_m < 1.0:
        return NotUsable("range too small for a rate")
    closing_m_s = -(beacon.x_m * beacon.vx_m_s + beacon.y_m * beacon.vy_m_s) / beacon.range_m
    return Approach(closing_m_s / beacon.range_m, 1.0 / beacon.range_m)


def _log_gaussian(value: float, mean: float, std: float) -> float:
    return -0.5 * ((value - mean) / std) ** 2 - math.log(std * math.sqrt(2.0 * math.pi))


class ScriptedCamera:
    """A camera of 36 deg to either side that sees the vehicle from `t0_s` on, and nothing else."""

    def __init__(self, beacons: list[Beacon], t0_s: float, miss_rate: float = 0.04) -> None:
        self._seen = {b.stamp_ns: b.azimuth_rad for b in beacons if b.stamp_ns >= nanoseconds(t0_s)}
        self._miss_rate = miss_rate

    def ask(
        self,
        stamp_ns: int,
        bearing: Bearing | NotUsable,
        expected_labels: Collection[str] | None = None,
        side: str | None = None,
    ) -> Absent | Present | Unqueried:
        """Answer for ten degrees around the bearing."""
        if isinstance(bearing, NotUsable) or abs(bearing.azimuth_rad) > 0.62:
            # A hidden vehicle is beyond the edge: what could be seen of it stands in line of sight.
            return Absent(self._miss_rate, 0.01)
        azimuth = self._seen.get(stamp_ns)
        there = azimuth is not None and abs(azimuth - bearing.azimuth_rad) < 0.17
        there = there and "car" in (expected_labels or {"car"})
        return Present(self._miss_rate, 0.01) if there else Absent(self._miss_rate, 0.01)

    def sightings(self, stamp_ns: int) -> tuple[Sighting, ...]:
        """Return the vehicle once it is in view."""
        azimuth = self._seen.get(stamp_ns)
        return () if azimuth is None else (Sighting(azimuth, 0.03, "car", 0.9, 0.1),)

    def last_look(self, stamp_ns: int) -> None:
        """Every answer is a look of its own: no camera here is asked by two sources."""


def approach_from_left(duration_s: float = 6.0, t0_s: float = 4.0) -> list[Beacon]:
    """Return the beacons of a car on the cross street, 10 m ahead, hidden by the corner until `t0_s`."""
    beacons, signature = [], RadioSignature()
    for hop in range(1, round(duration_s * 10) + 1):
        time_s = hop / 10.0
        y_m = 7.0 + 8.0 * (t0_s - time_s)
        beacon = Beacon(nanoseconds(time_s), 10.0, y_m, 0.0, -8.0, 0.0)
        corner_db = signature.corner_loss_db if time_s < t0_s else 0.0
        loss_db = signature.loss_at_1_m_db + 20.0 * math.log10(beacon.range_m) + corner_db
        power_dbm = signature.transmit_dbm - loss_db + 1.5 * math.sin(7.0 * hop)
        beacons.append(Beacon(beacon.stamp_ns, 10.0, y_m, 0.0, -8.0, power_dbm))
    return beacons


def run(
    beacons: list[Beacon], camera: CoEvidenceChannel | None, settings: FilterSettings = SETTINGS
) -> Iterator[WorldState]:
    """Yield the world-state after every beacon."""
    # A threshold of this modality's own; a budget would have to be calibrated for it.
    world = WorldFilter(policy=replace(uncalibrated_policy(), gamma=0.7), settings=settings)
    for measurement in BeaconAdapter(vision=camera).measure(beacons):
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        yield world.state


def main() -> None:
    """Print what is believed of one approach."""
    beacons = approach_from_left()
    for state in run(beacons, ScriptedCamera(beacons, t0_s=4.0)):
        if state.seq % 5 == 0:
            entities = ", ".join(
                f"{e.status} {e.id[:8]} at {math.degrees(e.azimuth_rad):+.0f} deg" for e in state.entities
            )
            print(f"{state.stamp_ns / 1e9:4.1f} s  risk {state.risk:.2f}  {entities or '-'}")


if __name__ == "__main__":
    main()
