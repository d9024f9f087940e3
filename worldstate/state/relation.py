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
        ``"occluded_by"``, ``"approaching_from"`` and ``"emerged_from"`` lead to an occluder,
        ``"approaching"`` and ``"conflicts_with_ego_path"`` (on the path ahead of it within five seconds) to
        the ego vehicle, ``"same_lane"`` and ``"in_front_of"`` to whom an entity is next ahead of, the ego
        vehicle or another entity; these three are told of entities with a position.
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
