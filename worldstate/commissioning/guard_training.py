"""Train a domain guard: streets against foreign sounds and warning signals."""

from collections.abc import Collection, Sequence
from functools import partial

import numpy as np

from worldstate.abduction.signature.domain_guard import DomainGuard
from worldstate.adapters.parallel import in_processes
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.spectra.sound_character import HOPS_A_SECOND, MEASURES
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import significant

from .heard_stream import HeardStream
from .sound_rows import FOREIGN, SIGNALS, STREET, SoundRows, fit_softmax, sound_rows, street_rows

FLAGGED = 0.025  # Share of the hops of each label of streets never heard that may be flagged
# Of the weight of all rows; within each the classes weigh the same, however long they were heard.
_STREET, _FOREIGN, _SIGNALS = 0.5, 0.3, 0.2
_FOLDS, _SITES_OF_SOUNDS = 5, 8  # More of either cost minutes
_EVERY = 8  # Neighbouring hops share nineteen twentieths of their sound
# The pitch of the strongest line belongs to the site: with it the false flags of SA1 rose from .04 to .09. It
# tells one signal from another, not the street from what is foreign.
_OF_SIGNALS_ONLY = ("line", "line varies", "line holds")
# Share of the rows of the signals that lie within their reach. At .995 a saw that was never heard is a signal
# in .58 of its hops and a tone in .27, at .97 in .37 and .11, and every tenth hop of known sirens is foreign.
_REACH = 0.98
_OWN_SPREAD = 0.1  # Share of the diagonal in the covariance of the signals
_FIGURES = 5  # Of a coefficient in the file, which is a fifth as long


def guard_rows(
    array: MicrophoneArray,
    streets: Sequence[HeardStream],
    rng: np.random.Generator,
    sounds_each: int = 1,
    jobs: int = 1,
) -> SoundRows:
    """Return the rows of streets, and those of so many sounds of each kind at some of their sites."""
    rate_hz = float(streets[0].hops.middle.shape[1] * HOPS_A_SECOND)
    sites = sorted({stream.site for stream in streets})[:_SITES_OF_SOUNDS] * sounds_each
    draws = list(zip(sites, rng.spawn(len(sites)), strict=True))
    heard = in_processes(partial(_sounds_at, array, rate_hz), draws, jobs)
    return SoundRows.joined([street_rows(streets), *heard])


def _sounds_at(array: MicrophoneArray, rate_hz: float, drawn: tuple[str, np.random.Generator]) -> SoundRows:
    name, rng = drawn
    return sound_rows(array, name, rate_hz, rng)


def train_guard(
    array: MicrophoneArray, streets: Sequence[HeardStream], rng: np.random.Generator, jobs: int = 1
) -> DomainGuard:
    """Train a guard on streets that were listened to, of two sites at least, and on sounds at these sites."""
    rows = guard_rows(array, streets, rng, jobs=jobs)
    found = [excess[~np.isnan(excess)] for excess in street_excesses(rows).values()]
    return fit_guard(rows, threshold_of(found))


def threshold_of(excesses: Sequence[FloatArray]) -> float:
    """Return the log-odds that no more than `FLAGGED` of the hops of any label exceed."""
    return max(float(np.quantile(excess, 1.0 - FLAGGED)) for excess in excesses if len(excess))


def street_excesses(rows: SoundRows, without: Collection[str] = ()) -> dict[str, FloatArray]:
    """Return the log-odds of the hops of streets, by label, from guards that never heard their site."""
    held_out: dict[str, list[FloatArray]] = {label: [] for label in STREET}
    names = np.unique(rows.sites)
    for fold in range(min(_FOLDS, len(names))):
        here = np.isin(rows.sites, names[fold::_FOLDS])
        guard = fit_guard(rows.select(~here & ~np.isin(rows.kinds, list(without))))
        for label in STREET:
            held_out[label].append(guard.log_odds(rows.measures[here & (rows.kinds == label)]))
    return {label: np.concatenate(found) for label, found in held_out.items()}


def fit_guard(rows: SoundRows, threshold: float = 0.0) -> DomainGuard:
    """Fit the coefficients of a guard to all rows, with a threshold from elsewhere."""
    foreign, signals = (_named(rows, names) for names in (FOREIGN, SIGNALS))
    weights, biases = _softmax(rows, foreign, signals)
    kinds = [kind for kind in SIGNALS if (rows.kinds == kind).any()]
    centres, whitening = _reach(rows, kinds)
    return DomainGuard(
        measures=MEASURES,
        foreign=foreign,
        signals=signals,
        weights=significant(weights, _FIGURES),
        biases=significant(biases, _FIGURES),
        threshold=threshold,
        kinds_of_signals=tuple(SIGNALS[kind] for kind in kinds),
        centres=significant(centres, _FIGURES),
        whitening=significant(whitening, _FIGURES),
    )


def _named(rows: SoundRows, names: dict[str, str]) -> tuple[str, ...]:
    heard = set(rows.kinds.tolist())
    return tuple(dict.fromkeys(name for kind, name in names.items() if kind in heard))


def _softmax(
    rows: SoundRows, foreign: tuple[str, ...], signals: tuple[str, ...]
) -> tuple[FloatArray, FloatArray]:
    """Fit weights, shape (classes, measures), and biases of raw measures, the street first."""
    names = {**dict.fromkeys((*STREET, ""), "street"), **FOREIGN, **SIGNALS}
    of_street = np.isin(rows.kinds, (*STREET, ""))
    kept = ~of_street | (np.arange(len(of_street)) % _EVERY == 0)
    order = ["street", *foreign, *signals]
    labels = np.array([order.index(names[kind]) for kind in rows.kinds[kept].tolist()])
    shares = np.array(
        [_STREET, *[_FOREIGN / len(foreign)] * len(foreign), *[_SIGNALS / len(signals)] * len(signals)]
    )
    weights = (shares / np.bincount(labels))[labels]
    of_all = ~np.isin(MEASURES, _OF_SIGNALS_ONLY)
    return fit_softmax(rows.measures[kept], labels, weights, weights * len(labels), of_all)


def _reach(rows: SoundRows, kinds: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    r"""Fit centres and whitening A of the signals, scaled so that `_REACH` of their rows lie within 1.

    .. math:: A^T A = \Sigma^{-1} / d^2
    """
    heard = [rows.measures[rows.kinds == kind] for kind in kinds]
    centres = np.array([one.mean(axis=0) for one in heard])
    apart = np.concatenate([one - centre for one, centre in zip(heard, centres, strict=True)])
    covariance = np.cov(apart, rowvar=False)
    covariance += _OWN_SPREAD * (np.diag(np.diag(covariance)) - covariance) + 1e-4 * np.eye(len(covariance))
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    squares = np.square(apart @ whitening.T).sum(axis=1)
    return centres, whitening / np.sqrt(np.quantile(squares, _REACH))
