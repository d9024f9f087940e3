"""A second modality: V2X beacons that a camera checks.

An equipped vehicle sends its position and speed ten times per second. Its radio signal passes a corner with a
loss of power, and anybody can send a false position. A beacon is therefore evidence like sound: its signature
is the received power, compared with the power at the claimed distance. Its co-evidence is the object that the
camera should see at the claimed position. `abduction` needs only log-likelihoods and the answer of the
camera.

The errors of two beacons are independent after the vehicle has moved by some metres, so their likelihoods are
multiplied.

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
# Assumed: shadowing is the same for 0.3 s, which is 2 m at the speed in a side street.
SETTINGS = FilterSettings(windows="likelihood", window_s=0.3)

# Labels that a detector should give each kind of station; a pedestrian need not be visible at all.
EXPECTED_LABELS: dict[str, Collection[str]] = {
    "passenger car": {"car"},
    "truck": {"truck", "bus"},
    "motorcycle": {"motorcycle"},
    "pedestrian": (),
}


@dataclass(frozen=True, slots=True)
class Beacon:
    """One V2X message in `base_link`, with its received power.

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
    """Likelihood of a beacon under each explanation.

    The loss above that of free space is Gaussian: with a mean of `corner_loss_db` behind a corner and 0 in
    view. Without a vehicle, the beacon is replayed or forged: its power is uniform over `ghost_range_db`,
    and its azimuth is uniform over the half-plane ahead. The azimuth of a hidden vehicle is Gaussian
    about that of an occluded approach. The rate of forged beacons is part of the context.
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
    """Convert beacons to measurements: a `MeasurementAdapter` for lists of beacons.

    Parameters
    ----------
    signature : RadioSignature, optional
        Model of the received power.
    vision : CoEvidenceChannel, optional
        Camera that checks the claimed position.
    """

    def __init__(
        self, signature: RadioSignature | None = None, vision: CoEvidenceChannel | None = None
    ) -> None:
        self.source = "v2x"
        self._signature = signature or RadioSignature()
        self._vision = vision

    def measure(self, beacons: list[Beacon], /) -> list[Measurement]:
        """Return one measurement per beacon, oldest first."""
        return [self._interpret(beacon) for beacon in sorted(beacons, key=lambda beacon: beacon.stamp_ns)]

    def _interpret(self, beacon: Beacon) -> Measurement:
        # The standard deviation corresponds to an error of 2 m at the claimed range.
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
            return Unqueried("no camera, or no visible object expected")
        return self._vision.ask(beacon.stamp_ns, bearing, expected)


def _approach(beacon: Beacon) -> Approach | NotUsable:
    if beacon.range_m < 1.0:
        return NotUsable("range too small for a rate")
    closing_m_s = -(beacon.x_m * beacon.vx_m_s + beacon.y_m * beacon.vy_m_s) / beacon.range_m
    return Approach(closing_m_s / beacon.range_m, 1.0 / beacon.range_m)


def _log_gaussian(value: float, mean: float, std: float) -> float:
    return -0.5 * ((value - mean) / std) ** 2 - math.log(std * math.sqrt(2.0 * math.pi))


class ScriptedCamera:
    """A camera of 36 degrees to each side that detects the vehicle from `t0_s` on, and nothing else."""

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
        """Return whether a car is within ten degrees of the bearing."""
        if isinstance(bearing, NotUsable) or abs(bearing.azimuth_rad) > 0.62:
            # A hidden vehicle is outside the view, and the camera finds nothing in the line of sight.
            return Absent(self._miss_rate, 0.01)
        azimuth = self._seen.get(stamp_ns)
        there = azimuth is not None and abs(azimuth - bearing.azimuth_rad) < 0.17
        there = there and "car" in (expected_labels or {"car"})
        return Present(self._miss_rate, 0.01) if there else Absent(self._miss_rate, 0.01)

    def sightings(self, stamp_ns: int) -> tuple[Sighting, ...]:
        """Return the vehicle if it is in view."""
        azimuth = self._seen.get(stamp_ns)
        return () if azimuth is None else (Sighting(azimuth, 0.03, "car", 0.9, 0.1),)

    def last_look(self, stamp_ns: int) -> None:
        """Return None: every answer is a new image, because only one source queries this camera."""


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
    # Assumed: no false-alarm rate was measured for this threshold.
    world = WorldFilter(policy=replace(uncalibrated_policy(), gamma=0.7), settings=settings)
    for measurement in BeaconAdapter(vision=camera).measure(beacons):
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        yield world.state


def main() -> None:
    """Print the states of one approach."""
    beacons = approach_from_left()
    for state in run(beacons, ScriptedCamera(beacons, t0_s=4.0)):
        if state.seq % 5 == 0:
            entities = ", ".join(
                f"{e.status} {e.id[:8]} at {math.degrees(e.azimuth_rad):+.0f} deg" for e in state.entities
            )
            print(f"{state.time_s:4.1f} s  risk {state.risk:.2f}  {entities or '-'}")


if __name__ == "__main__":
    main()
