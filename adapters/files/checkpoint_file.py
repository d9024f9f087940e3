"""Checkpoint files: filter, site estimate, history of the sequence, and sound of the arms."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from worldstate.abduction.sequence.sequence_reader import SequenceHistory
from worldstate.abduction.sequence.street_sides import StreetHearing
from worldstate.abduction.signature.site_estimate import SiteEstimate
from worldstate.core.filter import WorldFilter
from worldstate.ground.serialisation import decode, encode

from .file_io import read_json, refused_as_file, write_json


@dataclass(frozen=True, slots=True)
class PortNumbers:
    """Last accepted number of signed datagrams per port, so that a restart does not accept them again."""

    last: Mapping[str, int]


# Parts of a checkpoint in addition to the filter.
_BESIDE: dict[str, Any] = {
    "site": SiteEstimate, "history": SequenceHistory, "street": StreetHearing, "ports": PortNumbers,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """State of a chain between two hops; a restored chain continues bit for bit.

    Parameters
    ----------
    world : WorldFilter
        The filter with its belief.
    site : SiteEstimate or None
        `SiteSignature.estimate`; None if no site is learned.
    history : SequenceHistory or None
        `SequenceReader.history`; None without a sequence model.
    street : StreetHearing or None
        `StreetListener.hearing`; None without a sequence model.
    ports : PortNumbers or None
        None if no port has a key.
    senses : object or None
        Sound and images of the windows, from which a `Listener` continues at the next sample. It is not
        written to files.

    Examples
    --------
    >>> checkpoint = Checkpoint(WorldFilter().predict(0.3), SiteEstimate.start(60))
    >>> again = Checkpoint.from_dict(checkpoint.to_dict())
    >>> again.world.stamp_ns, again.site.heard_s
    (300000000, 0.0)
    """

    world: WorldFilter
    site: SiteEstimate | None = None
    history: SequenceHistory | None = None
    street: StreetHearing | None = None
    ports: PortNumbers | None = None
    senses: object = field(default=None, compare=False, repr=False)

    def to_dict(self) -> dict[str, Any]:
        """Return values for JSON: the filter's checkpoint with the other parts added."""
        beside = {name: getattr(self, name) for name in _BESIDE}
        return self.world.to_dict() | {k: None if v is None else encode(v) for k, v in beside.items()}

    @classmethod
    def from_dict(cls, data: Any) -> "Checkpoint":
        """Return what `to_dict` wrote; a checkpoint of the filter alone is read without the other parts.

        Raises
        ------
        SchemaVersionError
            If the schema or its major version differs.
        InvalidArgumentError
            If a value is missing, of the wrong type or out of range; the message contains its place.
        """
        world = WorldFilter.from_dict(data)
        beside = {name: (kind, data.get(name)) for name, kind in _BESIDE.items()}
        return cls(world, **{k: v if v is None else decode(kind, v, k) for k, (kind, v) in beside.items()})


def save_checkpoint(path: str | Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint to a file, atomically.

    Raises
    ------
    InputFileError
        If the folder is missing.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_checkpoint(Path(folder) / "now.json", Checkpoint(WorldFilter().predict(0.3)))
    ...     read_checkpoint(Path(folder) / "now.json").world.stamp_ns
    300000000
    """
    write_json(path, checkpoint.to_dict())


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Read a file written by `save_checkpoint`.

    Raises
    ------
    InputFileError
        If the file is missing, too large, truncated or not JSON, or a value is missing or out of range.
    SchemaVersionError
        If the file has another major version.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_checkpoint(Path(folder) / "now.json", Checkpoint(WorldFilter().predict(0.3)))
    ...     read_checkpoint(Path(folder) / "now.json").world.stamp_ns
    300000000
    """
    with refused_as_file(path):
        return Checkpoint.from_dict(read_json(path, "a checkpoint"))
