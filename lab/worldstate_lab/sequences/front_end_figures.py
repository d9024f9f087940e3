"""The paper's figures of the front-end (section IX) on real recordings of street corners."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from worldstate_lab.evaluation.front_end_study import front_end_study
from worldstate_lab.trials.listening import pass_time_s, tone_refusal
from worldstate_lab.trials.trial import Trial

from .recordings import CornerRecording

# By figure of `front_end_study`. MUSIC is missing: it needs the raw channels, which spectra do not contain.
PAPER: Mapping[str, float] = {
    "bearing_srp_deg": 3.4,
    "bearing_gated_deg": 2.4,
    "prominence_in_view": 1.60,
    "prominence_in_silence": 1.18,
    "looming_auroc": 0.735,
    "looming_correlation": 0.07,
    "doppler_usable": 1.0,  # One of 41 approaches
}
DRAWS = 500


def front_end_figures(
    trials: Sequence[Trial], recordings: Sequence[CornerRecording], rng: np.random.Generator
) -> dict[str, Any]:
    """Return each figure with its interval over recordings, and the paper's value.

    The trials are those of `hearing.heard` with a camera, whose boxes are the reference for the acoustic
    bearings. The tone of a pass is searched for in the first channel of the sound.
    """
    told = [_with_pass(*one) for one in zip(trials, recordings, strict=True)]
    study = front_end_study(told, rng, DRAWS)
    figures = {
        name: {"value": study.figures[name], "interval": study.intervals[name], "paper": paper}
        for name, paper in PAPER.items()
    }
    of = {"frames": study.frames, "approaches": study.approaches, "bearing_by_junction": study.by_site}
    return figures | of


def _with_pass(trial: Trial, recording: CornerRecording) -> Trial:
    """Add the time of the pass, the reason if its tone cannot be used, and missing MUSIC bearings."""
    about = {**trial.hops.about, "pass_s": None, "doppler": "no vehicle"}
    if not trial.hazard_free:
        samples, rate_hz = recording.samples()
        about |= {"pass_s": pass_time_s(trial.truth), "doppler": tone_refusal(samples[:, 0], rate_hz)}
    return replace(trial, hops=trial.hops.replace(music_rad=np.full(len(trial.hops), np.nan), about=about))
