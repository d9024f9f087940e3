"""Two-second clips of roadside traffic corpora: where each lies and what is known of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from worldstate.adapters.audio.sound_file import open_audio
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import Float32Array

CLIP_S = 2.0
BACKGROUND = "background"
# IDMT-Traffic has 17,506 clips and MELAUDIS about 16,000: a folder with many times as many is another one.
MAX_CLIPS = 200_000
# As many names as a reader of the message can act on.
_NAMED = 8


@dataclass(frozen=True, slots=True)
class ClipLabels:
    """What is known of a clip."""

    kind: str  # `BACKGROUND` or the kind of the one vehicle that passes
    microphone: str  # "studio", "mems" or "phone"
    recording: str  # Clips that share a day, a place and a background share it
    site: str
    split: str = ""  # "train" or "test" of an official split


@dataclass(frozen=True, slots=True)
class TrafficClip:
    """Two seconds of a sound file."""

    path: Path
    labels: ClipLabels
    start_s: float = 0.0


def read_clip(clip: TrafficClip) -> tuple[Float32Array, float]:
    """Return the samples of a clip, shape (n, channels), and their rate in Hz."""
    with open_audio(clip.path) as source:
        start, rate = round(clip.start_s * source.sample_rate_hz), source.sample_rate_hz
        # A few clips of MELAUDIS are shorter than two seconds.
        return source.span(start, min(round(CLIP_S * rate), source.frames - start)), float(rate)


def refuse_missing(root: Path, corpus: str, missing: Sequence[str]) -> None:
    """Refuse a folder that lacks something, with a list of it; none missing is fine."""
    if missing:
        more = f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
        raise InputFileError(root, f"expected {corpus}; missing: {', '.join(missing[:_NAMED])}{more}")


def check_number(root: Path, clips: Sequence[object]) -> None:
    """Refuse more clips than any of these corpora has."""
    if len(clips) > MAX_CLIPS:
        raise InputFileError(root, f"expected at most {MAX_CLIPS} clips, got {len(clips)}")
