"""The snapshot S_t."""

import json
from dataclasses import dataclass, field
from html import escape
from importlib import import_module
from importlib.resources import files
from typing import TYPE_CHECKING, Any, ClassVar, get_args

from worldstate.abduction.road_users import DomainVerdict, Foreign
from worldstate.abduction.sequence.sequence_reader import TOO_FEW
from worldstate.ground import LEAST_HEARD, InvalidArgumentError, NotUsable, replaced, seconds
from worldstate.ground.extras import optional
from worldstate.ground.serialisation import ADDED, Layout, decode, decode_json, encode
from worldstate.measurement.measurement import Bearing

from .context import Context
from .cue import Budget, CueList, Cues, RiskCue, WhyNot
from .entity import EGO, Entity, Event, Relation
from .sensor import MASKED, Delivery, Ego, Hearing, SearchedView, SensorHealth
from .text import state_lines, state_text

if TYPE_CHECKING:
    import networkx as nx
    from matplotlib.axes import Axes


@dataclass(frozen=True, slots=True, repr=False)
class WorldState:
    """S_t = {entities, relations, context, cues}, immutable and in canonical order.

    Parameters
    ----------
    stamp_ns : int
        Time of the state, ns on `clock`.
    seq : int
        Number of measurements so far.
    entities : tuple of Entity
        In order of birth.
    relations : tuple of Relation
        In order of their ends and kind.
    context : Context
        The place. Its priors are the probabilities of the explanations before the last evidence.
    cues : tuple of RiskCue
        One per direction, in order of direction; none before the first measurement.
    frame_id : str
        Axes of all quantities: x forward, y left, z up.
    clock : {"media", "unix", "monotonic"}
        Clock of `stamp_ns`: from the start of the recording, from 1970, or from an arbitrary time.
    calibrated : bool
        Whether the cues keep a budget of false alarms, with a model that was made for this array. It is false
        exactly if a cue is *uncalibrated*, *unheard* or *budget broken*; then no cue states an alpha.
    bearing : Bearing or None
        Loudest direction of the last measurement, with its standard deviation; None if it had none.
    domain : Familiar, Foreign, WarningSignal or None
        Whether the model was made for the sound of the last hop. `Foreign` has the reason, and the evidence
        of that hop is reduced; a warning signal comes from a vehicle.
    no_sequence : NotUsable or None
        Why the cues state no times.
    delivery : Delivery
        Number of measurements that arrived late, twice, or too late.
    valid_until_ns : int or None
        One second after the last measurement, ns: a reader must not use the state after that. None before the
        first measurement.
    sensors : tuple of SensorHealth
        Health of every sensor, in order of names.
    searched : tuple of SearchedView
        The last look of every camera and other searching sensor, in order of names.
    ego : Ego or None
        Pose and twist of the ego vehicle; None without odometry. With odometry the occluders of the context
        are given as seen from this pose.
    heard : tuple of Hearing, or None
        How well each array could receive a hidden vehicle; None without an array.
    budget : Budget or None
        Whether the alarms keep their budget, judged by the vehicles that a camera detects later; None without
        a sequence model.
    no_model : NotUsable or None
        Why no model reads the sound: no model was made for this array. Entities detected by sound then have
        no status, side or class, and cues have no side, risk or advisory. None with a model.
    events : tuple of Event
        Changes of entities at the last measurement, at most 64.

    Examples
    --------
    >>> state = WorldState(stamp_ns=0, seq=0)
    >>> state.risk, WorldState.from_json(state.to_json()) == state
    (0.0, True)
    """

    LAYOUT: ClassVar = Layout("worldstate.Snapshot", "4.2.0", order="stamp_ns clock seq frame_id")

    stamp_ns: int
    seq: int
    entities: tuple[Entity, ...] = ()
    relations: tuple[Relation, ...] = ()
    context: Context = field(default_factory=Context)
    cues: CueList = field(default_factory=Cues)
    frame_id: str = "base_link"
    clock: str = "media"
    calibrated: bool = False
    bearing: Bearing | None = None
    domain: DomainVerdict | None = None
    no_sequence: NotUsable | None = None
    delivery: Delivery = field(default_factory=Delivery)
    valid_until_ns: int | None = None
    sensors: tuple[SensorHealth, ...] = ()
    searched: tuple[SearchedView, ...] = ()
    events: tuple[Event, ...] = ()
    ego: Ego | None = None
    heard: tuple[Hearing, ...] | None = None
    budget: Budget | None = None
    no_model: NotUsable | None = field(default=None, metadata=ADDED)

    def __post_init__(self) -> None:
        # The order has no meaning, and must not make two equal states different.
        entities = sorted(self.entities, key=lambda entity: (entity.created_ns, entity.id))
        relations = sorted(self.relations, key=lambda edge: (edge.src, edge.dst, edge.kind, edge.stamp_ns))
        object.__setattr__(self, "entities", tuple(entities))
        object.__setattr__(self, "relations", tuple(relations))
        cues = sorted(self.cues, key=lambda cue: (cue.direction or "", cue.azimuth_rad))
        object.__setattr__(self, "cues", Cues(cue.at(self.stamp_ns) for cue in cues))

    def __repr__(self) -> str:
        lines = state_lines(self.seq > 0, self.cues, self.entities, self.bearing, self.no_model)
        return state_text(self.time_s, lines)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(repr(self))}</pre>"

    @property
    def time_s(self) -> float:
        """Time of the state on `clock`, s."""
        return seconds(self.stamp_ns)

    @property
    def left(self) -> RiskCue | None:
        """Cue of the approach side "left"; None if no cue has this direction, as without a model."""
        return next((cue for cue in self.cues if cue.direction == "left"), None)

    @property
    def right(self) -> RiskCue | None:
        """Cue of the approach side "right"; None if no cue has this direction, as without a model."""
        return next((cue for cue in self.cues if cue.direction == "right"), None)

    @property
    def risk(self) -> float | None:
        """Largest risk of all directions, 0 before the first measurement; None if no model states one."""
        risks = [cue.risk for cue in self.cues if cue.risk is not None]
        return max(risks, default=None if self.cues or self.no_model else 0.0)

    def graph(self) -> "nx.MultiDiGraph[str]":
        """Return the scene graph: nodes are the ego vehicle, entities and occluders, edges the relations.

        Nodes are keyed by id and carry ``type`` (``"ego"``, ``"occluder"`` or ``"entity"``) and the object as
        ``value``; edges are keyed by kind, with ``probability``, ``stamp_ns``, ``since_ns`` and ``until_ns``.

        Examples
        --------
        >>> from worldstate.state import Relation
        >>> graph = WorldState(0, 0, relations=(Relation("corner_left", "ego", "left_of", 1.0, 0),)).graph()
        >>> sorted(graph.nodes), graph.edges["corner_left", "ego", "left_of"]["probability"]
        (['corner_left', 'corner_right', 'ego'], 1.0)
        """
        # Imported here: the import takes 0.2 s, and most programs need no graph.
        graph: nx.MultiDiGraph = optional("networkx").MultiDiGraph()
        graph.add_node(EGO, type="ego", value=self.context)
        for occluder in self.context.occluders:
            graph.add_node(occluder.id, type="occluder", value=occluder)
        for entity in self.entities:
            graph.add_node(entity.id, type="entity", value=entity)
        for edge in self.relations:
            names = ("probability", "stamp_ns", "since_ns", "until_ns")
            graph.add_edge(edge.src, edge.dst, key=edge.kind, **{name: getattr(edge, name) for name in names})
        return graph

    def plot(self, axes: "Axes | None" = None) -> "Axes":
        """Draw the state from above, the ego vehicle at the bottom and its left on the left.

        Parameters
        ----------
        axes : matplotlib.axes.Axes, optional
            The axes to draw on; by default those of a new figure of pyplot.

        Returns
        -------
        matplotlib.axes.Axes
            ``axes.figure.savefig("state.png")`` writes it to a file.

        Raises
        ------
        MissingExtraError
            If matplotlib is not installed.

        Examples
        --------
        >>> WorldState(1_500_000_000, 0).plot().get_title(loc="left")[:5]
        '1.5 s'
        """
        # The drawing is in a higher layer, which nothing else in this package needs.
        drawn: Axes = import_module("worldstate.operations.viewing.state_figure").draw_state(self, axes)
        return drawn

    def to_dict(self) -> dict[str, Any]:
        """Return the snapshot as JSON-able values; unknown is None."""
        return encode(self)

    def to_json(self) -> str:
        """Return the snapshot as one line of strict JSON.

        Raises
        ------
        InvalidArgumentError
            If a number is NaN or infinite, which JSON cannot hold.
        """
        try:
            # A snapshot has no circular references; the check for them takes a tenth of the time.
            return json.dumps(self.to_dict(), allow_nan=False, check_circular=False, separators=(",", ":"))
        except ValueError as error:
            raise InvalidArgumentError(f"snapshot: expected finite numbers ({error})") from error

    @classmethod
    def from_dict(cls, value: object) -> "WorldState":
        """Return the snapshot that `to_dict` wrote; unknown keys are ignored.

        A snapshot of schema 3.x is upgraded, and `usable` of its cues is computed from its other fields.

        Raises
        ------
        SchemaVersionError
            On another schema or another major version.
        InvalidArgumentError
            If a value is missing, of the wrong type or out of range; the message contains its path.
        """
        return _upgraded(value) if is_former(value) else decode(cls, value, "snapshot")

    @classmethod
    def from_json(cls, text: str) -> "WorldState":
        """Return the snapshot that `to_json` wrote; errors are those of `from_dict`."""
        return cls.from_dict(decode_json(text, "snapshot"))


# Reasons for which no budget of alarms holds, so that a state is not calibrated.
_NO_BUDGET = {"uncalibrated", "unheard", "budget broken"}


def why_not(state: WorldState) -> tuple[WhyNot, ...]:
    """Return all reasons for which the cues of a snapshot must not be used, in the order of `WhyNot`.

    Parameters
    ----------
    state : WorldState
        With `calibrated` true if a budget was measured for the rule that raises alarms.

    Examples
    --------
    >>> why_not(WorldState(stamp_ns=2, seq=1, heard=(), valid_until_ns=1))
    ('uncalibrated', 'unheard', 'expired')
    """
    hearing = [one for one in state.heard or () if one.share >= LEAST_HEARD]
    applies: dict[WhyNot, bool] = {
        "uncalibrated": not state.calibrated,
        # An unusable hop is no evidence, and no budget was measured for such hops.
        "unheard": state.heard is not None and not hearing,
        "unknown sound": isinstance(state.domain, Foreign),
        "too little sound": state.no_sequence == TOO_FEW,
        "budget broken": state.budget is not None and state.budget.verdict == "broken",
        "expired": state.valid_until_ns is not None and state.stamp_ns > state.valid_until_ns,
        "masked": bool(hearing) and all(one.reason == MASKED for one in hearing),
    }
    return tuple(reason for reason in get_args(WhyNot) if applies[reason])


def judged(state: WorldState) -> WorldState:
    """Return a snapshot in which `usable` and `why_not` of the cues and `calibrated` are set.

    Examples
    --------
    >>> from worldstate.state import EvidenceTerms
    >>> heard = EvidenceTerms("coming", {"prior": 1.0}, 1.0, 0.0)
    >>> cue = RiskCue("left", 0.9, 0.3, 0.8, 0.95, 0.97, 3.1, None, evidence=heard)
    >>> judged(WorldState(0, 1, cues=(cue,), calibrated=True)).cues[0].usable
    True
    """
    reasons = why_not(state)
    cues = tuple(
        # No budget was measured for a side that no source distinguishes.
        replaced(cue, usable=not why, why_not=why)
        for cue in state.cues
        for why in [reasons or (() if cue.evidence else ("uncalibrated",))]
    )
    return replaced(state, cues=cues, calibrated=_NO_BUDGET.isdisjoint(reasons))


def is_former(value: object) -> bool:
    """Return whether a decoded snapshot is of schema 3.x, which is upgraded when it is read.

    Examples
    --------
    >>> is_former(WorldState(0, 0).to_dict())
    False
    """
    stamp = value.get("schema") if isinstance(value, dict) else None
    stated = stamp if isinstance(stamp, dict) else {}
    return stated.get("name") == WorldState.LAYOUT.schema and str(stated.get("version")).startswith("3.")


def _upgraded(value: Any) -> WorldState:
    """Return the snapshot that a value of schema 3.x holds."""
    # Two fields that were always 0 are ignored as unknown keys; the new fields of the cues are set below.
    cues, new = value.get("cues"), {"usable": False, "why_not": ["uncalibrated"]}
    if isinstance(cues, list):
        cues = [one | new if isinstance(one, dict) else one for one in cues]
    schema = {"name": WorldState.LAYOUT.schema, "version": WorldState.LAYOUT.version}
    state = decode(WorldState, value | {"schema": schema, "cues": cues}, "snapshot")
    # In schema 3.x `calibrated` was false during unusable hops and with a broken budget, even if a budget was
    # measured.
    stated = state.budget is not None or any(cue.alpha is not None for cue in state.cues)
    lost = not _NO_BUDGET.isdisjoint(why_not(replaced(state, calibrated=True)))
    return judged(replaced(state, calibrated=state.calibrated or (stated and lost)))


def snapshot_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a snapshot, which ships as ``data/snapshot.schema.json``.

    Returns
    -------
    dict
        The schema, for any validator; unknown keys are allowed.

    Examples
    --------
    >>> schema = snapshot_schema()
    >>> sorted(schema["$defs"])[:3], schema["properties"]["stamp_ns"]["type"]
    (['Advisory', 'AlarmPromise', 'Bearing'], 'integer')
    """
    shipped = files("worldstate") / "data" / "snapshot.schema.json"
    schema: dict[str, Any] = json.loads(shipped.read_text(encoding="utf-8"))
    return schema
