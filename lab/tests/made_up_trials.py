"""Recordings and decisions with known figures: 0.1-s hops from the first second on."""

import numpy as np
import soundfile
from worldstate_lab.trials.trial import BOX_COLUMNS, TRACK_COLUMNS, TRUTH_COLUMNS, Decisions, Trial

from worldstate.ground.errors import InputFileError
from worldstate.operations.recordings.hop_table import HopTable


def made_up(name, label="none", *, t0_s=5.0, hops=81, site="SA1", fingerprint="", in_view_rad=0.3, **about):
    """Return a recording with a moving box in view for one second from T0 on."""
    time_s = np.round(1.0 + 0.1 * np.arange(hops), 6)
    seen = (time_s > t0_s + 1e-6) & (time_s < t0_s + 1.0 + 1e-6) & (label != "none")
    columns = {
        "time_s": time_s,
        "reference_rad": np.where(seen, in_view_rad, np.nan),
        "prominence": np.linspace(1.0, 2.0, hops),
    }
    about = {"site": site, "fingerprint": fingerprint or name, **about}
    hops_table = HopTable(columns, name, label, np.nan if label == "none" else t0_s, about)
    box = (0.0, 0.0, 1.0, 1.0), 1.0, "car", in_view_rad, True
    boxes = [(i, time_s[i], *box) for i in np.flatnonzero(seen)]
    truth = [(moment, 0, in_view_rad, there) for moment, there in zip(time_s, seen, strict=True)]
    return Trial(
        hops_table,
        boxes=HopTable.of_rows(BOX_COLUMNS, boxes),
        truth=HopTable.of_rows(TRUTH_COLUMNS, () if label == "none" else truth),
    )


def alarmed(trial, spans, **columns):
    """Return decisions in alarm from each start to each end, in seconds, without the end."""
    time_s = trial.hops.time_s
    on = [(time_s > start - 1e-6) & (time_s < end - 1e-6) for start, end in spans]
    return Decisions.of(time_s, np.any(on, axis=0) if on else np.zeros(len(time_s), bool), **columns)


def random_study(rng, *, approaches=8, calm=7, seeds=1, hops=60):
    """Return recordings at two sites and random decisions, with values in all columns."""
    labels = ["left" if i % 2 else "right" for i in range(approaches)] + ["none"] * calm
    trials = [
        made_up(f"r{i:03d}", label, t0_s=4.0 + 0.1 * (i % 7), hops=hops, site=f"S{i % 3}")
        for i, label in enumerate(labels)
    ]
    return trials, [[random_answer(one, rng) for one in trials] for _ in range(seeds)]


def random_answer(trial, rng):
    n = len(trial.hops)
    # Rounded, so that ties occur.
    score = np.round(np.clip(rng.normal(0.4 if trial.hazard_free else 0.6, 0.2, n), 0.0, 1.0), 2)
    best_s = np.where(rng.random(n) < 0.7, rng.exponential(2.0, n), np.nan)
    return Decisions.of(
        trial.hops.time_s,
        alarm=score > 0.8,
        side=rng.integers(-1, 2, n),
        bearing_rad=rng.normal(0.3, 0.1, n),
        score=score,
        risk=score**2,
        visible_s=np.stack([best_s - 1.0, best_s, best_s + 1.0], axis=1),
        tracks=tracked(trial, rng.random(n) < 0.8, rng.integers(0, 2, n), rng.normal(0.3, 0.2, n)),
    )


def tracked(trial, there, names, azimuth_rad):
    """Return tracks with at most one per hop."""
    rows = zip(trial.hops.time_s[there], names[there], azimuth_rad[there], strict=True)
    return HopTable.of_rows(TRACK_COLUMNS, rows)


def gram(path):
    """Return products of the channels of a sound file, which several BLAS threads may compute."""
    try:
        sound, _ = soundfile.read(path)
    except soundfile.LibsndfileError as error:
        raise InputFileError(path, "expected a sound file") from error
    return sound.T @ sound
