"""Relations: directed, typed and uncertain edges between entities, occluders and the ego vehicle."""

from dataclasses import dataclass
from typing import Any

from worldstate.ground.reading import Record

EGO = "ego"


@dataclass(frozen=True, slots=True)
class Relation:
    """An edge of the scene graph.

    Parameters
    ----------
    src, dst : str
        Ids of entities or occluders, or ``"ego"``.
    kind : str
        ``"occluded_by"`` and ``"emerged_from"`` lead to an occluder, ``"approaching"`` to the ego vehicle.
    probability : float
        Probability that it holds, given that both ends exist.
    stamp_ns : int
        Time of the belief, ns.

    Examples
    --------
    >>> Relation("a", EGO, "approaching", 0.9, 0).kind
    'approaching'
    """

    src: str
    dst: str
    kind: str
    probability: float
    stamp_ns: int

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values."""
        return {
            "src": self.src,
            "dst": self.dst,
            "kind": self.kind,
            "probability": self.probability,
            "stamp_ns": self.stamp_ns,
        }

    @classmethod
    def from_record(cls, record: Record) -> "Relation":
        """Return the relation that `to_dict` wrote.

        Raises
        ------
        InvalidArgumentError
            If a value is missing, of the wrong type or out of range.
        """
        return cls(
            src=record.text("src"),
            dst=record.text("dst"),
            kind=record.text("kind"),
            probability=record.probability("probability"),
            stamp_ns=record.integer("stamp_ns"),
        )
