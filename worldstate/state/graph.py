"""The scene graph of a snapshot as a networkx graph."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from .context import Context
from .entity import Entity
from .relation import EGO, Relation

if TYPE_CHECKING:
    import networkx as nx


def scene_graph(
    entities: Iterable[Entity], relations: Iterable[Relation], context: Context
) -> "nx.MultiDiGraph[str]":
    """Return a networkx MultiDiGraph, nodes keyed by id, edges by the kind of relation.

    A node carries ``type`` (``"ego"``, ``"occluder"`` or ``"entity"``) and the object as ``value``; an edge
    carries ``probability``, ``stamp_ns``, ``since_ns`` and ``until_ns``.

    Parameters
    ----------
    entities : iterable of Entity
        Nodes.
    relations : iterable of Relation
        Edges.
    context : Context
        The ego vehicle and the occluders, nodes too.

    Returns
    -------
    networkx.MultiDiGraph
        A new one.

    Examples
    --------
    >>> graph = scene_graph([], [Relation("corner_left", EGO, "left_of", 1.0, 0)], Context())
    >>> graph.edges["corner_left", "ego", "left_of"]["probability"]
    1.0
    """
    # Imported here: whoever never asks for a graph does not wait for networkx.
    import networkx as nx

    graph = nx.MultiDiGraph()
    graph.add_node(EGO, type="ego", value=context)
    for occluder in context.occluders:
        graph.add_node(occluder.id, type="occluder", value=occluder)
    for entity in entities:
        graph.add_node(entity.id, type="entity", value=entity)
    for edge in relations:
        names = ("probability", "stamp_ns", "since_ns", "until_ns")
        graph.add_edge(edge.src, edge.dst, key=edge.kind, **{name: getattr(edge, name) for name in names})
    return graph
