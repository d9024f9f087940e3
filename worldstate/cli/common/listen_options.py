"""Options of the model and of how it listens, the same for a recording and for microphones that run."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .array_options import search_of

if TYPE_CHECKING:
    from worldstate.abduction.sequence.street_sides import SidePatterns
    from worldstate.adapters.listen import ListenSettings
    from worldstate.state import Context


def add_listen_options(parser: argparse.ArgumentParser) -> None:
    """Declare --model, --alpha, --site-adaptation, --uncalibrated, --grounded, --ego-noise and --context."""
    add = parser.add_argument
    add("--model", type=Path, help="model file (default: the one that ships)")
    add("--alpha", type=float, default=0.02, help="false-positive budget (default: %(default)s)")
    add(
        "--site-adaptation", action=argparse.BooleanOptionalAction, default=True,
        help="learn what the site is like while listening (default: on)",
    )  # fmt: skip
    add("--forgetting", type=float, metavar="S", help="time constant of that, seconds (default: 300)")
    add(
        "--uncalibrated", action="store_true",
        help="go on where the model was made for another array or rate; no cue states an alpha then",
    )  # fmt: skip
    grounded = "weigh windows with bearing and approach, eq. (5), not the sequence (default: off)"
    add("--grounded", action="store_true", help=grounded)
    ego_noise = "learn the own vehicle's noise while nothing is there and hear past it (default: off)"
    add("--ego-noise", action="store_true", help=ego_noise)
    place = (
        "corners, lanes and rates of this place, JSON (default: a usual blind junction, and states say so)"
    )
    add("--context", type=Path, metavar="FILE", help=place)
    street = "edges, pace and sides of this place as learn-street wrote them, in place of --context"
    add("--street", type=Path, metavar="JSON", help=street)


def add_memory_options(parser: argparse.ArgumentParser, start: str) -> None:
    """Declare --resume, --start and --save-state; `start` says what counts without --start."""
    add = parser.add_argument
    add("--resume", type=Path, metavar="STATE", help="go on from what --save-state wrote")
    first = f"time of the first sample on the states' clock (default: {start})"
    add("--start", type=float, metavar="S", help=first)
    add("--save-state", type=Path, metavar="STATE", help="keep belief and site for --resume")


def listen_settings(arguments: argparse.Namespace) -> "ListenSettings":
    """Return how it is listened to, boxes and silent channels by default."""
    from dataclasses import replace

    from worldstate.adapters.acoustic_grounding import Grounding

    return replace(
        search_of(arguments),
        alpha=arguments.alpha,
        site_adaptation=arguments.site_adaptation,
        forgetting_s=arguments.forgetting,
        grounding=Grounding() if arguments.grounded else None,
        ego_noise=arguments.ego_noise,
        uncalibrated=arguments.uncalibrated,
    )


def given_context(arguments: argparse.Namespace) -> "Context | None":
    """Return the place that --context or --street names, None without them."""
    from worldstate.adapters.files.context_file import read_context
    from worldstate.ground.errors import InvalidArgumentError
    from worldstate.operations.labelling.street_file import read_street
    from worldstate.smoothing.learned_street import context_of

    if arguments.street is None:
        return None if arguments.context is None else read_context(arguments.context)
    if arguments.context is not None:
        raise InvalidArgumentError("--street: expected it without --context, both say what stands there")
    return context_of(read_street(arguments.street))


def given_sides(arguments: argparse.Namespace) -> "SidePatterns | None":
    """Return what either arm of the place that --street names sounds like, None without it."""
    from worldstate.operations.labelling.street_file import read_street

    return None if arguments.street is None else read_street(arguments.street).patterns
