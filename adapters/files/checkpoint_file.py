"""Checkpoints on disk: the filter's memory, site estimate, a sequence's history, the sound of the arms."""

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
    """Numbers of signed datagrams that were taken last, by port: what a restart must not take again."""

    last: Mapping[str, int]


# What a checkpoint holds beside the memory of the filter.
_BESIDE: dict[str, Any] = {
    "site": SiteEstimate, "history": SequenceHistory, "street": StreetHearing, "ports": PortNumbers,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A chain between two hops; what is read back continues bit for bit.

    Parameters
    ----------
    world : WorldFilter
        The belief.
    site : SiteEstimate or None
        `SiteSignature.estimate`; None where no site is learned.
    history : SequenceHistory or None
        `SequenceReader.history`; None without a sequence model.
    street : StreetHearing or None
        `StreetListener.hearing`; likewise.
    ports : PortNumbers or None
        None where no port has a key.
    senses : object or None
        What a `Listener` goes on with at the very next sample: the sound and images of its windows. No file
        holds it.

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
        """Return JSON-able values: the filter's checkpoint with the other parts beside its memory."""
        beside = {name: getattr(self, name) for name in _BESIDE}
        return self.world.to_dict() | {k: None if v is None else encode(v) for k, v in beside.items()}

    @classmethod
    def from_dict(cls, data: Any) -> "Checkpoint":
        """Return what `to_dict` wrote; the filter's own checkpoint reads as one without the other parts.

        Raises
        ------
        SchemaVersionError
            On another schema or another major version.
        InvalidArgumentError
            If a value is missing, of the wrong type or out of range; the message says where.
        """
        world = WorldFilter.from_dict(data)
        beside = {name: (kind, data.get(name)) for name, kind in _BESIDE.items()}
        return cls(world, **{k: v if v is None else decode(kind, v, k) for k, (kind, v) in beside.items()})


def save_checkpoint(path: str | Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint to exactly this path, whole or not at all.

    Parameters
    ----------
    path : str or Path
        Exactly this file.
    checkpoint : Checkpoint
        Filter and site.

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
    """Read a checkpoint.

    Parameters
    ----------
    path : str or Path
        What `save_checkpoint` wrote.

    Returns
    -------
    Checkpoint
        Filter and site.

    Raises
    ------
    InputFileError
        If the file is missing, too large, truncated or no JSON, or a value is missing or out of range.
    SchemaVersionError
        If it is of another major version.

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
