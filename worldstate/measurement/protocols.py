"""Protocols of a modality: measurement adapter and co-evidence channel."""

from collections.abc import Collection
from typing import Literal, Protocol, TypeVar

from worldstate.abduction.co_evidence import CoEvidence
from worldstate.ground.values import NotUsable

from .measurement import Bearing, Look, Measurement, Sighting

RawT = TypeVar("RawT", contravariant=True)

Side = Literal["left", "right"]


class MeasurementAdapter(Protocol[RawT]):
    """Turns raw input of one modality into measurements; generic in what it takes.

    The acoustic adapter takes blocks of samples, a radar one would take sweeps. To write one for another
    modality:

    - Take any amount of raw input per call and return the measurements that became complete with it: none,
      one or many, in the order of their stamps. Cutting the input elsewhere must not change them.
    - Stamp each with the end of the interval that it observed, integer nanoseconds on the stream's clock.
    - Give evidence as log-likelihoods under hidden (one per direction), visible and none, up to a common
      constant. A modality that cannot tell hidden from visible gives both the same value.
    - Say `Unqueried` where no co-evidence channel was asked, and `NotUsable` with the reason for a bearing or
      an approach rate that cannot be given. Never put 0 or NaN in their place.
    - Azimuth is in `base_link`, radians, left positive, in (-pi, pi]. Convert here, nowhere else.
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
        """Take the next piece of raw input; return the measurements completed by it, oldest first."""
        ...


class CoEvidenceChannel(Protocol):
    """A channel that searches a sector for the co-evidence that a signature predicts.

    `adapters.camera.vision_query.VisionQuery` is one, over recorded detections; a live detector is another.

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
        """Search the sector around the bearing, or a whole side; None expects the channel's usual classes."""
        ...

    def sightings(self, stamp_ns: int) -> tuple[Sighting, ...]:
        """Return all objects that the channel detects at this instant, in any sector."""
        ...

    def last_look(self, stamp_ns: int) -> Look | None:
        """Return the search of the whole view that counts at this instant, None where there was none."""
        ...
