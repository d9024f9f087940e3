"""Log-likelihoods of signature classifiers on the features of trials, and their training windows."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from worldstate.abduction.signature.ensemble import AnySignature, EnsembleModel
from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.adapters.datasets.feature_extraction import (
    FRONT,
    FRONT_LATER_S,
    LabelledWindow,
    extract_features,
    feature_table,
    sample_windows,
)
from worldstate.adapters.datasets.feature_table import FeatureTable, Group, read_features, write_features
from worldstate.adapters.datasets.ovad import choose_array
from worldstate.adapters.files.acoustic_domain import check_array, ovad_domain
from worldstate.adapters.files.model_file import save_model
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InvalidArgumentError, OutOfDomainError
from worldstate.ground.serialisation import encode
from worldstate.ground.typing import FloatArray
from worldstate.operations.training.site_references import with_site_references
from worldstate.operations.training.training import TrainingSettings, fit_ensemble, train_model
from worldstate.simulation.scene.junction import SITES
from worldstate.simulation.scene.presets import DEFAULT_PRESET, preset
from worldstate_lab.features.published_classifier import PublishedClassifier
from worldstate_lab.streets.simulated_windows import LAYOUT, simulated_window_pair

from .pass_cache import fingerprint, origin_of
from .trial import TakeList, Trial

# Columns of hidden left and hidden right.
SIDE_COLUMNS = slice(0, 2)
# All windows; those of junctions other than the tested one; or, if only the test recordings are available,
# windows cut from the calibration recordings of the fold.
TrainedOn = Literal["all", "other junctions", "calibration"]


def classified(trial: Trial, name: str, signature: AnySignature) -> Trial:
    """Add the log-likelihoods and the prior of a classifier to a trial, under a name."""
    model = SiteSignature(signature) if isinstance(signature, EnsembleModel) else signature
    evidence = np.stack([model.evidence(feature).log_likelihoods for feature in trial.hops.features])
    priors = {**trial.hops.about.get("prior", {}), name: list(signature.reference_prior)}
    about = {**trial.hops.about, "prior": priors}
    return replace(trial, hops=trial.hops.replace(**{name: evidence}, about=about))


def posteriors(trial: Trial, evidence: str) -> FloatArray:
    """Return the posteriors of hidden left, hidden right, visible and none at the classifier's own prior."""
    joint = trial.hops.columns[evidence] + np.log(trial.hops.about["prior"][evidence])
    return np.asarray(np.exp(joint - np.logaddexp.reduce(joint, axis=1, keepdims=True)))


@dataclass(slots=True)
class Classifiers:
    """The published classifier, trained for each fold on the permitted windows; each training runs once."""

    windows: FeatureTable | None  # Released, simulated or extracted windows, without those of test recordings
    told: str = ""  # Their origin, for the report
    _trained: dict[tuple[str, ...], dict[str, AnySignature]] = field(default_factory=dict)
    _heard: dict[tuple[tuple[str, ...], str], Trial] = field(default_factory=dict)

    def trained_on(self, kind: TrainedOn) -> TrainedOn:
        """Return the training data in use: the calibration recordings if there are no windows."""
        return "calibration" if self.windows is None else kind

    def classify(
        self, kind: TrainedOn, calibration: Sequence[Trial], tested: Sequence[Trial], seed: int
    ) -> tuple[list[Trial], list[Trial]]:
        """Return both parts of a fold with the posteriors of the classifiers for this fold."""
        group: Group = "dynamic" if tested[0].hops.about["moving"] else "static"
        left_out = sorted({junction_of(one.site) for one in tested}) if kind == "other junctions" else []
        key: tuple[str, ...] = (kind, group, str(seed), *left_out)
        if self.windows is None:
            key = ("calibration", str(seed), *(one.name for one in calibration))
        if key not in self._trained:
            if self.windows is None:
                table = windows_of(calibration)
            else:
                table = _other_windows(self.windows.group(group), tested, left_out)
            # The keys are names of evidence: the classifier of the paper, and the ensemble that this library
            # ships, both trained on the same windows.
            published = PublishedClassifier(np.random.default_rng(seed))
            self._trained[key] = {
                "published": published.fit(table.features, table.labels).model_,
                "ensemble": fit_ensemble(with_site_references(table)),
            }
        before, after = ([self._classified(key, one) for one in part] for part in (calibration, tested))
        return before, after

    def _classified(self, key: tuple[str, ...], trial: Trial) -> Trial:
        # The same classifiers are applied to the same trial in many folds and protocols.
        if (key, trial.name) not in self._heard:
            heard = trial
            for name, signature in self._trained[key].items():
                heard = classified(heard, name, signature)
            self._heard[key, trial.name] = heard
        return self._heard[key, trial.name]


def _other_windows(table: FeatureTable, tested: Sequence[Trial], left_out: Sequence[str]) -> FeatureTable:
    """Return the windows without those of some junctions; there may be none of a test recording."""
    shared = ", ".join(sorted({one.name for one in tested} & set(table.ids.tolist()))[:5])
    if shared:
        raise InvalidArgumentError(f"windows: expected none of a test recording, got those of {shared}")
    return table.select(np.array([junction_of(one) not in left_out for one in table.environments.tolist()]))


def junction_of(site: str) -> str:
    """Return the junction of a site, for a standing or a moving ego.

    Examples
    --------
    >>> junction_of("SA1"), junction_of("DA1")
    ('A1', 'A1')
    """
    return site[1:]


def windows_of(trials: Sequence[Trial]) -> FeatureTable:
    """Cut labelled windows from processed recordings: at T0, 1.5 s later, and within hazard-free ones."""
    rows = []
    for trial in trials:
        time_s = trial.hops.time_s
        if trial.hazard_free:
            wanted = {"none": float(np.median(time_s))}
        else:
            wanted = {trial.label: trial.t0_s, FRONT: trial.t0_s + FRONT_LATER_S}
        for label, end_s in wanted.items():
            hop = int(np.abs(time_s - end_s).argmin())
            # If no hop ends at this time, the window would differ.
            if abs(time_s[hop] - end_s) <= 0.051:
                rows.append((trial.hops.features[hop], label, trial.name, trial.site))
    if not rows:
        raise InvalidArgumentError("trials: expected windows at T0 or in hazard-free time to train on")
    features, labels, names, sites = (np.array(column) for column in zip(*rows, strict=True))
    return FeatureTable(features, labels, names, sites, names, (None,) * len(rows))


# Increased whenever the same windows would give a different model.
VERSION = 2
# Gives 170 windows of each kind at the five standing sites: left and right together, front, and none. The
# released set has 170, 170 and 158 without its 42 + 42 and 41 test windows.
PER_APPROACH = 17


def windows_from_table(path: Path, takes: TakeList) -> tuple[FeatureTable, str]:
    """Read a table of windows without those of the test recordings; return it with a description.

    Raises
    ------
    OutOfDomainError
        If the windows are of another array than the recordings.
    """
    table = read_features(path)
    domain = table.domain or ovad_domain(table.environments.tolist())
    try:
        check_array(
            domain, choose_array(takes.root), "Extract windows of these recordings (extract-features)"
        )
    except OutOfDomainError as error:
        raise OutOfDomainError(f"{path}: windows of another array; {error}") from error
    tested = {take.name for take in (*takes.static, *takes.dynamic)}
    kept = table.without(tested) if set(table.ids.tolist()) & tested else table
    left_out = len(table) - len(kept)
    return kept, f"{len(kept)} windows of {path.name}, {left_out} of test recordings left out"


def windows_from_recordings(takes: TakeList, folder: Path) -> tuple[FeatureTable, str] | None:
    """Extract the windows of the recordings that are not tested; None if there are none."""
    names = {take.name for take in takes.training}
    if not names:
        return None
    found = [window for window in sample_windows(takes.root)[0] if window.path.parent.name in names]
    array = choose_array(takes.root)
    path = folder / f"windows-{windows_origin(found, array, folder / 'fingerprints')}.csv"
    if not path.is_file():
        write_features(path, feature_table(found, list(extract_features(found, array)), array))
    table = read_features(path)
    return table, f"{len(table)} windows of {len(names)} recordings outside the test set"


def windows_origin(windows: Sequence[LabelledWindow], array: MicrophoneArray, memo: Path) -> str:
    """Return a hash of 32 characters of all inputs of window features: sound, time, label and array."""
    marks = {path: fingerprint(path, memo) for path in {window.path for window in windows}}
    listed = [
        (one.window_id, one.label, one.environment, one.t0_frame, one.end_s, marks[one.path])
        for one in windows
    ]
    return origin_of([listed, array.positions_m.tolist()])


def windows_from_simulation(
    folder: Path,
    seed: int,
    *,
    per_approach: int = PER_APPROACH,
    sites: Sequence[str] = SITES,
    jobs: int = 1,
    progress: Callable[[], None] = lambda: None,
) -> tuple[FeatureTable, str]:
    """Simulate windows at the junctions of the test recordings, with a separate seed."""
    levels = preset(DEFAULT_PRESET)
    origin = origin_of([LAYOUT, asdict(levels), seed, per_approach, list(sites)])
    path = folder / f"windows-{origin}.csv"
    if not path.is_file():
        # Different from the seeds of the recordings: no window is from a test recording.
        apart = int(np.random.SeedSequence((seed, 1)).generate_state(1)[0])
        windows, _ = simulated_window_pair(
            per_approach, apart, sites=sites, jobs=jobs, levels=levels, progress=progress
        )
        write_features(path, windows)
    # The sound is rendered at a quarter of the rate but with the bins of the full rate, so the feature is
    # that of OVAD's array.
    table = replace(read_features(path), domain=ovad_domain(sites))
    return table, f"{len(table)} simulated windows of the same junctions, other recordings"


def model_from_windows(windows: FeatureTable, folder: Path, seed: int) -> Path:
    """Train this library's model on the windows of a standing ego, and return its file.

    In the paper's sweep over camera states the classifier is trained on the same junctions; the shipped model
    is trained on other ones.
    """
    table = windows.group("static")
    # Labels, recordings and domain of the rows; their numbers are added below.
    told = [table.labels.tolist(), table.recording_keys.tolist(), encode(table.domain)]
    path = folder / f"trained-{origin_of([VERSION, seed, told, table.features.tolist()])}.json"
    if not path.is_file():
        settings = TrainingSettings(seed=seed, repeats=1)
        save_model(path, train_model(table, settings, dataset="training windows", group="static"))
    return path
