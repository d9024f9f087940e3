"""`worldstate-lab kinds`: classification of road users by their sound.

Single vehicles of every kind pass drawn junctions, are recorded by one microphone, and are classified (car,
van, truck, tram, motorcycle, bicycle) at junctions outside the training. Hops with a vehicle more than 6 dB
below the ambience belong to the class *unknown*. Figures cover the hops from 3 s before to 1.5 s after line
of sight, with the kinds as frequent as in a town.

Examples
--------
  worldstate-lab kinds --junctions 16 --passes 2 --jobs 2
"""

import argparse
from typing import Any

import numpy as np

from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar
from worldstate.commissioning.guard_training import close_rows
from worldstate.commissioning.heard_stream import CommissionSettings, learned_streams
from worldstate.commissioning.road_user_training import (
    CLASSES,
    RoadUserRows,
    cross_validated,
    road_user_rows,
    town_shares,
    with_close,
)
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground.checks import in_range
from worldstate_lab.report.table import Table, json_values

CLIPS_EACH = 20


def road_user_exam(rows: RoadUserRows) -> dict[str, Any]:
    """Evaluate every site with a model trained without it, kinds as frequent as in a town.

    The hops are those near line of sight.
    """
    near, said = rows.select(rows.counts), cross_validated(rows)[rows.counts]
    classes, shares = near.classes, town_shares(near)
    losses, prior = -np.log(said[np.arange(len(said)), classes]), -np.log(shares[classes])
    gains = [
        float(np.average((losses - prior)[here], weights=near.weights[here]))
        for here in (near.sites == name for name in np.unique(near.sites))
    ]
    # A class without hops has a row of zeros.
    hops = np.bincount(classes, minlength=len(CLASSES)).astype(np.float64)
    confusion = np.stack([said[classes == number].sum(axis=0) for number in range(len(CLASSES))])
    recall, of_equals = (
        np.bincount(classes, one.argmax(axis=1) == classes, len(CLASSES)) / np.maximum(hops, 1.0)
        for one in (said, said / shares)
    )
    return {
        "log_loss": float(np.average(losses, weights=near.weights)),  # Mean of -ln p of the true class; nats
        # The same for the shares of the classes in a town
        "prior_log_loss": float(np.average(prior, weights=near.weights)),
        # The largest difference of the two at any site; negative if the model is better everywhere
        "worst_site": max(gains),
        "classes": CLASSES,
        "shares": shares,  # Shares in a town, as in the model
        "hops": hops,  # Number
        "confusion": confusion / np.maximum(hops, 1.0)[:, None],  # Mean probability, one row per true class
        "recall": recall,  # Share of hops in which the true class is the likeliest
        "recall_of_equals": of_equals,  # The same for equally frequent classes
    }


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--junctions", type=int, default=16, metavar="N", help="random junctions (default: %(default)s)")
    of_each = "passes of each kind per junction (default: %(default)s)"
    add("--passes", type=int, default=2, metavar="N", help=of_each)
    add("--seed", type=int, default=0, help="seed of vehicles and drives (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    in_range("--passes", arguments.passes, 1, 100)
    plan = learned_streams(CommissionSettings(junctions=arguments.junctions))
    sites = list(dict.fromkeys(one.site.name for one in plan))
    rng = np.random.default_rng(arguments.seed)
    rate_hz = plan[0].sample_rate_hz
    # One microphone is used: one of another array would record the same, and the level is not used.
    passes, jobs = arguments.passes, arguments.jobs
    with progress_bar("rendering", passes * len(sites)) as bar:
        rows = road_user_rows(
            ovad_array(), sites, rate_hz, rng, passes=passes, jobs=jobs, on_pass=bar.advance
        )
    # Close passes with other recorders, as in a made model: part of the training, and of no evaluated
    # junction.
    rows = with_close(rows, close_rows(rate_hz, rng, CLIPS_EACH, jobs))
    found = road_user_exam(rows)
    columns = ("classes", "shares", "hops", "recall", "recall_of_equals")
    rows_of = zip(*(found[name] for name in columns), found["confusion"], strict=True)
    cells = [(*one, *map(float, probabilities)) for *one, probabilities in rows_of]
    heads = ("class", "share", "hops", "recall", "of equals", *(f"p({name})" for name in CLASSES))
    summary = {name: round(found[name], 3) for name in ("log_loss", "prior_log_loss", "worst_site")}
    lines = ["", *Table("kinds", "Mean probabilities by true class", heads, cells).lines()]
    return CommandResult(json_values(found), table=summary, lines=lines)
