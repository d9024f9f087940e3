"""Relations: directed, typed and uncertain edges between entities, occluders and the ego vehicle."""

from dataclasses import dataclass

from worldstate.ground.serialisation import Probability

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
    since_ns, until_ns : int or None
        Interval in which the probability was last at least .5, ns; the first is None if it never was, the
        second while it is. Both are forgotten five seconds after its end.

    Examples
    --------
    >>> Relation("a", EGO, "approaching", 0.9, 0).kind
    'approaching'
    """

    src: str
    dst: str
    kind: str
    probability: Probability
    stamp_ns: int
    since_ns: int | None = None
    until_ns: int | None = None
