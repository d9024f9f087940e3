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
from dataclasses import asdict, dataclass

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
from worldstate.ground.typing import FloatArray

CLIPS_EACH = 20


@dataclass(frozen=True, slots=True, eq=False)
class RoadUserExam:
    """Hops near line of sight, at sites outside the training."""

    log_loss: float  # Mean of -ln p of the true class; nats
    prior_log_loss: float  # The same for the shares of the classes in a town
    # The largest difference of the two at any site; negative if the model is better everywhere
    worst_site: float
    classes: tuple[str, ...]
    shares: FloatArray  # shape (classes,): Shares in a town, as in the model
    hops: FloatArray  # shape (classes,): Number
    confusion: FloatArray  # shape (classes, classes): Mean probability, one row per true class
    recall: FloatArray  # shape (classes,): Share of hops in which the true class is the likeliest
    recall_of_equals: FloatArray  # shape (classes,): The same for equally frequent classes


def road_user_exam(rows: RoadUserRows) -> RoadUserExam:
    """Evaluate every site with a model trained without it, kinds as frequent as in a town."""
    near = rows.select(rows.counts)
    return _examined(near, cross_validated(rows)[rows.counts], near.weights, town_shares(near))


def _examined(near: RoadUserRows, said: FloatArray, weights: FloatArray, shares: FloatArray) -> RoadUserExam:
    classes = near.classes
    losses = -np.log(said[np.arange(len(said)), classes])
    prior = -np.log(shares[classes])
    gains = [
        float(np.average((losses - prior)[here], weights=weights[here]))
        for here in (near.sites == name for name in np.unique(near.sites))
    ]
    # A class without hops has a row of zeros.
    counts = np.bincount(classes, minlength=len(CLASSES)).astype(np.float64)
    confusion = np.stack([said[classes == number].sum(axis=0) for number in range(len(CLASSES))])
    hits, equals = (one.argmax(axis=1) == classes for one in (said, said / shares))
    return RoadUserExam(
        log_loss=float(np.average(losses, weights=weights)),
        prior_log_loss=float(np.average(prior, weights=weights)),
        worst_site=max(gains),
        classes=CLASSES,
        shares=shares,
        hops=counts,
        confusion=confusion / np.maximum(counts, 1.0)[:, None],
        recall=np.bincount(classes, hits, len(CLASSES)) / np.maximum(counts, 1.0),
        recall_of_equals=np.bincount(classes, equals, len(CLASSES)) / np.maximum(counts, 1.0),
    )


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
    report = {name: np.asarray(one).tolist() for name, one in asdict(found).items()}
    summary = {name: round(getattr(found, name), 3) for name in ("log_loss", "prior_log_loss", "worst_site")}
    named = zip(found.classes, found.shares, found.hops, found.recall, found.recall_of_equals, strict=True)
    lines = ["", f"{'class':12}{'share':>7}{'hops':>7}{'recall':>8}{'of equals':>11}  mean probabilities"]
    for number, (name, share, hops, recall, equals) in enumerate(named):
        shares = "".join(f"{one:7.2f}" for one in found.confusion[number])
        lines.append(f"{name:12}{share:7.3f}{hops:7.0f}{recall:8.2f}{equals:11.2f}  {shares}")
    return CommandResult(report, table=summary, lines=lines)
