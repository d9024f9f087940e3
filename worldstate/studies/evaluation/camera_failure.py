"""The degradation sweep on the recordings of an evaluation that were filmed."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from worldstate.adapters.datasets.ovad import Recording
from worldstate.adapters.files.model_file import read_model
from worldstate.studies.degradation.degradation_study import (
    DegradationSettings,
    DegradationStudy,
    Item,
    Tables,
    degradation_study,
)
from worldstate.studies.degradation.sweep_data import sweep_data
from worldstate.studies.trials.engine import Engine, Failed
from worldstate.studies.trials.listening import model_refusal
from worldstate.studies.trials.pass_cache import FingerprintMemo, PassCache, fingerprint
from worldstate.studies.trials.takes import TakeList

Begin = Callable[[str, int], None]


def whole_sweep(takes: TakeList, settings: DegradationSettings) -> DegradationSettings:
    """Return the settings of a sweep over all filmed recordings, in place of an even choice of them."""
    calm = [take.hazard_free for take in takes.static if take.filmed]
    return replace(settings, approaches=calm.count(False), hazard_free=calm.count(True))


def lacking_films(takes: TakeList, settings: DegradationSettings) -> str | None:
    """Say what the sweep needs and does not find; its model has to be made for the sound."""
    model = read_model(settings.model)
    for take in takes.static:
        if take.filmed and (refusal := model_refusal(take, model)) is not None:
            return f"needs a model that was made for this sound; {refusal}"
    return sweep_data(_filmed(takes), settings.approaches, settings.hazard_free).lacks


def camera_failure(
    takes: TakeList,
    cache: Path,
    engine: Engine,
    settings: DegradationSettings,
    begin: Begin,
    advance: Callable[[], None],
) -> DegradationStudy:
    """Run the sweep; the recordings are worked on as all others are, and what was seen is kept in `cache`."""

    def over(work: Callable[[Item], Tables], items: Sequence[Item]) -> Iterator[Tables | str]:
        begin("degrading the camera", len(items))
        for found in engine.over(work, items):
            advance()
            yield found.problem if isinstance(found, Failed) else found

    named = partial(fingerprint, memo=FingerprintMemo(cache / "fingerprints"))
    return degradation_study(
        _filmed(takes), settings, over=over, keep=PassCache(cache).tables, fingerprint=named
    )


def _filmed(takes: TakeList) -> list[Recording]:
    return [Recording.open(take.path) for take in takes.static if take.filmed]
