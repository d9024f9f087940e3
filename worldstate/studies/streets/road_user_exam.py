"""How well kinds of road users are told at sites never heard: log-loss, recall and confusion."""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.operations.commissioning.road_user_training import (
    CLASSES,
    RoadUserRows,
    class_shares,
    cross_validated,
)


@dataclass(frozen=True, slots=True, eq=False)
class RoadUserExam:
    """Hops near line of sight, at sites that were not learned."""

    log_loss: float  # Mean of -ln p of the true class, kinds as frequent as in a town; nats
    prior_log_loss: float  # Of the shares of the classes instead
    worst_site: float  # The largest difference of the two at any site; negative where better everywhere
    classes: tuple[str, ...]
    shares: FloatArray  # shape (classes,): In a town
    hops: FloatArray  # shape (classes,): Number
    confusion: FloatArray  # shape (classes, classes): Mean probability, one row a true class
    recall: FloatArray  # shape (classes,): Share in which the true class is the likeliest
    recall_of_equals: FloatArray  # shape (classes,): The same if all classes were as frequent


def road_user_exam(rows: RoadUserRows) -> RoadUserExam:
    """Judge every site by a model that never heard it."""
    said = cross_validated(rows)[rows.counts]
    near = rows.select(rows.counts)
    classes, weights, shares = near.classes, near.weights, class_shares(near)
    losses = -np.log(said[np.arange(len(said)), classes])
    prior = -np.log(shares[classes])
    gains = [
        float(np.average((losses - prior)[here], weights=weights[here]))
        for here in (near.sites == name for name in np.unique(near.sites))
    ]
    # A class that no hop has leaves a row of zeros.
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
