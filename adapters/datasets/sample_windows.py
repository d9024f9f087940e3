"""Labelled one-second windows of a data set in OVAD's layout, cut where the released program cuts them."""

from pathlib import Path

from .feature_extraction import WINDOW_S, LabelledWindow
from .ovad import FRAME_RATE_HZ, OvadDataset, Recording

MOVING_LATER_S, FRONT_LATER_S = 0.5, 1.5
FRONT = "front"


def window_ends_s(label: str, t0_s: float, moving_ego: bool) -> dict[str, float]:
    """Return by label when the windows of a recording end.

    Examples
    --------
    >>> window_ends_s("left", 7.0, moving_ego=False), window_ends_s("none", 7.0, moving_ego=True)
    ({'left': 7.0, 'front': 8.5}, {'none': 7.5})
    """
    # With a standing ego the window of the recording's own label ends at T0, with a moving one 0.5 s later;
    # an approach has a front window besides, which ends 1.5 s after that.
    end_s = t0_s + (MOVING_LATER_S if moving_ego else 0.0)
    return {label: end_s} if label == "none" else {label: end_s, FRONT: end_s + FRONT_LATER_S}


def sample_windows(root: str | Path) -> tuple[list[LabelledWindow], int]:
    """List the windows of every recording that ``DataLog.csv`` names."""
    # Front windows are numbered among themselves, class number 0, as in the released list.
    windows: list[LabelledWindow] = []
    fronts = left_out = 0
    for number, recording in enumerate(OvadDataset(root).recordings):
        found = _windows(recording, str(number), fronts)
        fronts += sum(window.label == FRONT for window in found)
        with recording.open_audio() as source:
            inside = [w for w in found if w.end_s and WINDOW_S <= w.end_s <= source.duration_s]
        windows += inside
        left_out += len(found) - len(inside)
    return windows, left_out


def _windows(recording: Recording, number: str, fronts: int) -> list[LabelledWindow]:
    label, place, frame = recording.label, recording.environment, recording.logged_frame
    if label is None or place is None or frame is None:
        return []
    front_id = f"0{recording.recording_id[1:5]}{fronts:04d}"
    return [
        LabelledWindow(
            window_id=front_id if what == FRONT else recording.recording_id,
            label=what,
            environment=place,
            recording=number,
            t0_frame=frame,
            path=recording.audio_path,
            end_s=end_s,
        )
        for what, end_s in window_ends_s(label, frame / FRAME_RATE_HZ, bool(recording.moving_ego)).items()
    ]
