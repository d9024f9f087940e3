"""The degradation sweep on the recordings of an evaluation that were filmed, and on its streams."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from worldstate.adapters.datasets.ovad import Recording
from worldstate.adapters.files.model_file import model_to_dict, read_model
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.degradation.degradation_study import (
    DegradationSettings,
    DegradationStudy,
    Item,
    Tables,
    degradation_study,
)
from worldstate_lab.degradation.stream_sweep import (
    VERSION,
    StreamSweep,
    staged_advisories,
    states_told,
    stream_sweep,
)
from worldstate_lab.degradation.sweep_data import sweep_data
from worldstate_lab.trials.engine import Engine, Failed
from worldstate_lab.trials.hearing import Hearing
from worldstate_lab.trials.listening import model_refusal
from worldstate_lab.trials.pass_cache import FingerprintMemo, PassCache, fingerprint
from worldstate_lab.trials.takes import Take, TakeList

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


@dataclass(frozen=True, slots=True)
class _Staged:
    """Work on one stream, in any process."""

    hearing: Hearing
    seed: int

    def __call__(self, take: Take) -> HopTable:
        """Return the advisories of every state of the camera, or what an earlier run found."""
        folder, model = self.hearing.folder, self.hearing.model
        mark = fingerprint(take.path, FingerprintMemo(folder / "fingerprints"))
        key = [VERSION, mark, states_told(), model_to_dict(read_model(model)), self.seed]

        def make() -> dict[str, HopTable]:
            return {"advised": staged_advisories(take.path, model, self.seed)}

        return PassCache(folder).tables("staged-streams", key, make)["advised"]


def staged_streams(
    takes: Sequence[Take],
    hearing: Hearing,
    engine: Engine,
    seed: int,
    begin: Begin,
    advance: Callable[[], None],
) -> StreamSweep:
    """Stage every state of camera and roof on streams that nobody comes out of a hidden arm in."""
    if not takes:
        raise InvalidArgumentError("needs a stream of two minutes or more without hazards, found none")
    begin("staging camera and rain on streams", len(takes))
    found = []
    for one in engine.over(_Staged(hearing, seed), takes, lambda take: take.name):
        if isinstance(one, Failed):
            raise InvalidArgumentError(f"{one.name}: {one.problem}")
        found.append(one)
        advance()
    return stream_sweep(found, seed)


def _filmed(takes: TakeList) -> list[Recording]:
    return [Recording.open(take.path) for take in takes.static if take.filmed]
