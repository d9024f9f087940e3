"""Measurements: evidence of one modality at one instant, and the protocols of a modality."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import ClassVar, Literal, Protocol, TypeVar

from worldstate.abduction.co_evidence import CoEvidence
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.road_users import ClassShares, DomainVerdict, class_shares
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.ground.checks import ABOVE_ZERO, MOST, all_of, check_fields, in_range, named, pair
from worldstate.ground.serialisation import ADDED, Layout, Probability
from worldstate.ground.values import LEAST_HEARD, NotUsable, integer_ns

_AZIMUTHS_RAD, _STDS_RAD = (-math.pi, math.pi), (ABOVE_ZERO, 1e3)
_SIGHTING = {
    "azimuth_rad": _AZIMUTHS_RAD,
    "std_rad": _STDS_RAD,
    "label": str,
    "score": (0.0, 1.0),
    "width_rad": (0.0, math.tau),
    "moving": bool,
}
MOST_LOOKS = 32  # Maximum number of cameras of a car
_MOST_SIGHTINGS = 100_000  # The filter uses at most 64 of them


@dataclass(frozen=True, slots=True)
class Bearing:
    """A measured azimuth.

    Parameters
    ----------
    azimuth_rad : float
        In (-pi, pi], left positive, in `base_link`.
    std_rad : float
        Standard deviation for a line-of-sight source; a hidden one has its own measurement model.
    prominence : float
        Peak-to-median ratio of the spatial spectrum, >= 1.
    at_edge : bool
        Whether the peak is at the edge of the searched sector, so that the source may be beyond it.

    Raises
    ------
    InvalidArgumentError
        If a part has the wrong type or range.

    Examples
    --------
    >>> Bearing(0.3, 0.06, 1.4).azimuth_rad
    0.3
    """

    azimuth_rad: float
    std_rad: float
    prominence: float = 1.0  # A flat spectrum, which contains no information
    at_edge: bool = field(default=False, metadata=ADDED)

    def __post_init__(self) -> None:
        check_fields(self, azimuth_rad=_AZIMUTHS_RAD, std_rad=_STDS_RAD, prominence=(0.0, MOST), at_edge=bool)


@dataclass(frozen=True, slots=True)
class Approach:
    """A measured approach rate: the reciprocal time to arrival 1/TTA = -r_dot/r.

    Parameters
    ----------
    inverse_tta_hz : float
        1/s, positive while closing.
    std_hz : float
        Standard deviation, 1/s, > 0.

    Raises
    ------
    InvalidArgumentError
        If a part has the wrong type or range.

    Examples
    --------
    >>> Approach(inverse_tta_hz=0.5, std_hz=0.25).inverse_tta_hz
    0.5
    """

    inverse_tta_hz: float
    std_hz: float

    def __post_init__(self) -> None:
        check_fields(self, inverse_tta_hz=(-1e3, 1e3), std_hz=(ABOVE_ZERO, 1e6))


@dataclass(frozen=True, slots=True)
class Heard:
    """How likely a hidden vehicle would have been detected in a hop of sound, and the reason.

    Parameters
    ----------
    share : float
        P(a hidden vehicle would have been noticed), in [0, 1].
    reason : str or None
        Why it is low: "lost samples", "clipped", "noise far above this place's usual", "wind", "dead
        channels", "loud source in view", "a sound that the models do not know", or an ego speed outside the
        training data; None if nothing reduces it.
    excess_db : float
        Level of the sound above what is usual at this place, dB.
    measured : bool
        False if nothing measures the share; the snapshot then contains none.
    kinds : mapping of str to float, or None
        For each kind of road user, the noticed share under the conditions of the model's exam; None if it was
        not measured.

    Raises
    ------
    InvalidArgumentError
        If a part has the wrong type or range.

    Examples
    --------
    >>> Heard(0.7, "lost samples").share
    0.7
    """

    share: Probability = 1.0
    reason: str | None = None
    excess_db: float = field(default=0.0, metadata=ADDED)
    measured: bool = field(default=True, metadata=ADDED)
    kinds: Mapping[str, Probability] | None = field(default=None, metadata=ADDED)

    @property
    def usable(self) -> bool:
        """Whether the hop is used as evidence; if the share is below 0.2, silence has no meaning."""
        return self.share >= LEAST_HEARD

    def __post_init__(self) -> None:
        check_fields(self, share=(0.0, 1.0), reason=str | None, excess_db=(-1e3, 1e3), measured=bool)
        check_fields(self, kinds=Mapping | None)
        for kind, share in (self.kinds or {}).items():
            in_range(f"kinds[{kind!r:.40}]", share, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Sighting:
    """One object that the co-evidence channel has detected.

    Parameters
    ----------
    azimuth_rad : float
        In (-pi, pi], left positive, in `base_link`.
    std_rad : float
        Standard deviation of the azimuth.
    label : str
        Class name; for known data sets, the library's name of the class.
    score : float
        Detector confidence in [0, 1].
    width_rad : float
        Angular width.
    moving : bool
        False for an object that has stood still long enough to be parked.

    Raises
    ------
    InvalidArgumentError
        If a part has the wrong type or range.

    Examples
    --------
    >>> Sighting(0.2, 0.02, "car", 0.9).moving
    True
    """

    azimuth_rad: float
    std_rad: float
    label: str
    score: float
    width_rad: float = 0.0
    moving: bool = True  # A single image does not show motion

    def __post_init__(self) -> None:
        check_fields(self, **_SIGHTING)


@dataclass(frozen=True, slots=True)
class Look:
    """One search of a sensor's whole view, which is used once, however many measurements contain it.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    stamp_ns : int
        Time of the search, nanoseconds on the stream's clock; for an image, when it was taken.
    answer : Present, Absent or Unqueried
        Whether any moving object is in view, with the miss rate and the clutter rate of the whole view.
    sector_rad : (float, float) or None
        The searched sector, from its right end to its left end. None for the view of the context.
    fault : str or None
        Known fault of the sensor, in words; it appears in the snapshot.

    Raises
    ------
    InvalidArgumentError
        If a part has the wrong type or range.

    Examples
    --------
    >>> from worldstate.abduction import Absent
    >>> Look("camera", 100_000_000, Absent(miss_rate=0.06)).sensor
    'camera'
    """

    sensor: str
    stamp_ns: int
    answer: CoEvidence
    sector_rad: tuple[float, float] | None = field(default=None, metadata=ADDED)
    fault: str | None = field(default=None, metadata=ADDED)

    def __post_init__(self) -> None:
        named("sensor", self.sensor)
        object.__setattr__(self, "stamp_ns", integer_ns("stamp_ns", self.stamp_ns))
        check_fields(self, answer=CoEvidence, fault=str | None)
        if self.sector_rad is not None:
            object.__setattr__(self, "sector_rad", pair("sector_rad", self.sector_rad, math.tau))


@dataclass(frozen=True, slots=True)
class CameraLook:
    """A look of one of several cameras, with its sightings.

    Parameters
    ----------
    look : Look
        The search, with its own sector.
    sightings : tuple of Sighting
        All detections of the camera.

    Raises
    ------
    InvalidArgumentError
        If a part has the wrong type or range.

    Examples
    --------
    >>> from worldstate.abduction import Absent
    >>> CameraLook(Look("left", 100_000_000, Absent(0.06), (0.4, 1.9))).sightings
    ()
    """

    look: Look
    sightings: tuple[Sighting, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self, look=Look)
        object.__setattr__(self, "sightings", _sightings(self.sightings))


def _sightings(values: object) -> tuple[Sighting, ...]:
    return all_of("sightings", values, Sighting, _MOST_SIGHTINGS)


_BY_SENSOR = attrgetter("look.sensor")
_PARTS = {
    "signature": SignatureEvidence,
    "co_evidence": CoEvidence,
    "bearing": Bearing | NotUsable,
    "approach": Approach | NotUsable,
    "look": Look | None,
    "domain": DomainVerdict | None,
    "sequence": SequenceReading | NotUsable | None,
    "fault": str | None,
    "heard": Heard,
}


@dataclass(frozen=True, slots=True)
class Measurement:
    """Evidence of one modality at one instant, with the answer of its co-evidence channel.

    Parameters
    ----------
    stamp_ns : int
        End of the observed interval, nanoseconds on the stream's clock.
    signature : SignatureEvidence
        Log-likelihoods of the observation under every explanation.
    co_evidence : CoEvidence
        Present, Absent or Unqueried.
    bearing, approach : Bearing or Approach, or NotUsable
        NotUsable if it is missing; a filter must marginalise over it.
    sightings : tuple of Sighting
        All detections of the co-evidence channel, inside and outside the queried sector.
    look : Look or None
        The search behind co-evidence and sightings; None means a search by the source itself at the stamp.
    further : tuple of CameraLook
        Looks of further cameras, each with its own sector. The co-evidence is then the joint answer of all
        cameras for the sector of the sound.
    domain : Familiar, Foreign, WarningSignal or None
        Whether the sound belongs to the model's domain; None if that is unknown.
    kinds : tuple of (str, float)
        Classes of the sound with their probabilities, sorted by name; empty if unknown.
    sequence : SequenceReading, NotUsable or None
        Evidence of the last seconds about vehicles that come into view; None without such a model.
    source : str
        Name of the modality.
    fault : str or None
        Known fault of the sensor, in words; it appears in the snapshot.
    heard : Heard
        How likely a hidden vehicle would have been noticed; 1 for a modality without masking.

    Raises
    ------
    InvalidArgumentError
        If a part has the wrong type or range.

    Examples
    --------
    >>> from worldstate.abduction import Absent, SignatureEvidence
    >>> heard = SignatureEvidence(("left", "right"), hidden=(2.0, -1.0), visible=1.0, none=-2.0)
    >>> unknown = NotUsable("not measured")
    >>> measurement = Measurement(100_000_000, heard, Absent(miss_rate=0.04), unknown, unknown, source="v2x")
    >>> measurement.source, measurement.bearing.reason
    ('v2x', 'not measured')
    """

    # Written without a kind, as in checkpoints that are older than position scans.
    LAYOUT: ClassVar = Layout()

    stamp_ns: int
    signature: SignatureEvidence
    co_evidence: CoEvidence
    bearing: Bearing | NotUsable
    approach: Approach | NotUsable
    sightings: tuple[Sighting, ...] = ()
    look: Look | None = None
    domain: DomainVerdict | None = None
    kinds: ClassShares = ()
    sequence: SequenceReading | NotUsable | None = None
    # Overlap is discounted within a source, and evidence is multiplied across sources. Two sources with the
    # same name would be treated as one source with overlapping evidence.
    source: str = "acoustic"
    fault: str | None = None
    further: tuple[CameraLook, ...] = field(default=(), metadata=ADDED)
    heard: Heard = field(default=Heard(), metadata=ADDED)

    def __post_init__(self) -> None:
        named("source", self.source)
        check_fields(self, **_PARTS)
        object.__setattr__(self, "stamp_ns", integer_ns("stamp_ns", self.stamp_ns))
        object.__setattr__(self, "sightings", _sightings(self.sightings))
        object.__setattr__(self, "further", all_of("further", self.further, CameraLook, MOST_LOOKS))
        object.__setattr__(self, "kinds", class_shares("kinds", self.kinds))

    @property
    def looks(self) -> tuple[CameraLook, ...]:
        """All looks in the order of their sensors; for one sensor, the measurement's own look is first."""
        own = self.look or Look(self.source, self.stamp_ns, self.co_evidence)
        return tuple(sorted((CameraLook(own, self.sightings), *self.further), key=_BY_SENSOR))


RawT = TypeVar("RawT", contravariant=True)

Side = Literal["left", "right"]


class MeasurementAdapter(Protocol[RawT]):
    """Converts raw input of one modality into measurements; generic in the type of its input.

    The acoustic adapter takes blocks of samples; a radar adapter would take sweeps. Rules for an adapter of
    another modality:

    - Take any amount of raw input per call, and return the measurements that it completes: none, one or many,
      in the order of their stamps. Other cuts of the input must not change them.
    - The stamp is the end of the observed interval, integer nanoseconds on the stream's clock.
    - Evidence consists of log-likelihoods under hidden (one per direction), visible and none, up to a common
      constant. A modality that does not separate hidden from visible gives both the same value.
    - Return `Unqueried` if no co-evidence channel was queried, and `NotUsable` with the reason for a missing
      bearing or approach rate. Never use 0 or NaN instead.
    - Set `heard` to P(a hidden vehicle would have been noticed) if that is less than 1.
    - Azimuth is in `base_link`, radians, left positive, in (-pi, pi]. Convert it here and nowhere else.
    - Check raw input once, here, and raise the typed errors of `worldstate.errors`.

    Attributes
    ----------
    source : str
        Name of the modality, copied into every measurement.

    Examples
    --------
    An adapter without measurements, for blocks of bytes:

    >>> class Deaf:
    ...     source = "deaf"
    ...     def measure(self, block: bytes) -> list[Measurement]:
    ...         return []
    >>> adapter: MeasurementAdapter[bytes] = Deaf()
    >>> adapter.measure(b"")
    []
    """

    source: str

    def measure(self, block: RawT, /) -> list[Measurement]:
        """Process the next piece of raw input; return the measurements that it completes, oldest first."""
        ...


class CoEvidenceChannel(Protocol):
    """A channel that searches a sector for the co-evidence that a signature predicts.

    `adapters.camera.vision_query.VisionQuery` does this on recorded detections.

    Examples
    --------
    >>> from worldstate.abduction.co_evidence import Unqueried
    >>> class Blind:
    ...     def ask(self, stamp_ns, bearing, expected_labels=None, side=None): return Unqueried("no camera")
    ...     def sightings(self, stamp_ns): return ()
    ...     def last_look(self, stamp_ns): return None
    >>> channel: CoEvidenceChannel = Blind()
    >>> channel.ask(0, NotUsable("flat spectrum")).reason
    'no camera'
    """

    def ask(
        self,
        stamp_ns: int,
        bearing: Bearing | NotUsable,
        expected_labels: Collection[str] | None = None,
        side: Side | None = None,
    ) -> CoEvidence:
        """Search the sector around the bearing, or a whole side, for the given or the usual classes."""
        ...

    def sightings(self, stamp_ns: int) -> tuple[Sighting, ...]:
        """Return all objects that the channel detects at this instant, in any sector."""
        ...

    def last_look(self, stamp_ns: int) -> Look | None:
        """Return the search of the whole view that applies at this instant; None without one."""
        ...
