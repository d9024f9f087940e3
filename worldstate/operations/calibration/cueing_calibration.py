"""Thresholds and risk maps from whole recordings, for `worldstate model threshold`.

The inputs are data sets, recordings, sound files or saved hop streams.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.cueing.cueing_policy import (
    CueingPolicies,
    CueingPolicy,
    neyman_pearson_threshold,
    sustained_statistic,
)
from worldstate.abduction.cueing.risk_map import IsotonicMap, RiskMap, fit_risk_map
from worldstate.adapters.datasets.ovad import LOG_NAME, OvadDataset, Recording
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.listener import measure_steps
from worldstate.adapters.source import open_source
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground import InvalidArgumentError, finite_array, in_range
from worldstate.ground.errors import InputFileError, OutOfDomainError
from worldstate.ground.typing import FloatArray
from worldstate.operations.corpus.corpus_tables import HeardHop, corpus_rows
from worldstate.operations.metrics.approach_table import ApproachTable, caution, poisson_interval
from worldstate.operations.recordings.hop_table import (
    HOP_S,
    STREAM_COLUMNS,
    HopTable,
    hop_stream,
    load_streams,
    signature_checksum,
)
from worldstate.operations.training.training import MISS_RATES

# Number of recording-level folds for the achieved rate.
N_FOLDS = 5
# With fewer false alarms in total, their rate is uncertain by more than a factor of two.
ENOUGH_ONSETS = 10


@dataclass(frozen=True, slots=True)
class CueingSettings:
    """Settings of the thresholds.

    Parameters
    ----------
    alphas : tuple of float
        Budgets: share of hazard-free windows in sustained alarm, in (0, 1).
    sustain_hops : int
        k of the sustained rule.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> CueingSettings(alphas=(0.02,)).sustain_hops
    3
    """

    alphas: tuple[float, ...] = (0.01, 0.02, 0.05)
    sustain_hops: int = 3

    def __post_init__(self) -> None:
        if not self.alphas:
            raise InvalidArgumentError("alpha: expected at least one budget")
        for alpha in self.alphas:
            in_range("alpha", alpha, 0.0, 1.0, open_low=True, open_high=True)

    def threshold(self, hazard_free: Sequence[FloatArray], alpha: float) -> float:
        """Return gamma(alpha) for hazard-free recordings."""
        return neyman_pearson_threshold(hazard_free, alpha, self.sustain_hops)


@dataclass(frozen=True, slots=True)
class BudgetReport:
    """Results for one budget."""

    alpha: float  # The budget
    miss_rate: float  # beta of the statistic
    gamma: float  # The threshold
    counted: ApproachTable  # False alarms on the recordings on which the threshold was set
    # Share of windows in alarm over recording-level folds, with thresholds from the other folds. None with a
    # single recording.
    held_out_rate: float | None
    held_out_per_hour: float | None  # False alarms per hour over the same folds

    def to_dict(self) -> dict[str, object]:
        """Return values for JSON."""
        rates = self.counted.false_alarms()
        return {
            "alpha": self.alpha,
            "miss_rate": self.miss_rate,
            "gamma": self.gamma,
            "window_rate": rates["hazard_free_share"],
            "false_alarms_per_hour": rates["onsets_per_hour"],
            "false_alarms_per_hour_95": [rates["onsets_low"], rates["onsets_high"]],
            "quantum_per_hour": 1.0 / self.counted.hours,
            "held_out_window_rate": self.held_out_rate,
            "held_out_false_alarms_per_hour": self.held_out_per_hour,
        }


@dataclass(frozen=True, slots=True)
class CueingCalibration:
    """Policies, with their achieved rates and reliability.

    Parameters
    ----------
    policies : CueingPolicies
        One per budget and miss rate.
    budgets : tuple of BudgetReport
        Results in the same order.
    hours, windows, recordings : float and int
        Hours, number of decision windows and number of recordings without hazards.
    correlation_time_s : float
        Correlation time of the statistic at miss rate 0.
    risk : {"kept", "platt", "isotonic"}
        Origin of the risk map.
    warnings : tuple of str
        Figures for which there are too few hours.

    Examples
    --------
    >>> from worldstate.adapters.files.model_file import read_model
    >>> shipped = read_model().policies
    >>> found = CueingCalibration(shipped, (), 0.5, 18_000, 3, 1.1, "kept", ("too few hours",))
    >>> found.policies.for_alpha(0.02).alpha, found.warnings
    (0.02, ('too few hours',))
    """

    policies: CueingPolicies
    budgets: tuple[BudgetReport, ...]
    hours: float
    windows: int
    recordings: int
    correlation_time_s: float
    risk: str
    warnings: tuple[str, ...]


def calibrate_cueing(
    streams: Sequence[HopTable],
    reference_prior: tuple[float, ...],
    kept: CueingPolicies,
    settings: CueingSettings | None = None,
) -> CueingCalibration:
    """Set gamma(alpha) on hazard-free recordings, and the risk map if there are approaches with a T0.

    Parameters
    ----------
    streams : sequence of HopTable
        Hazard-free recordings, and optionally approaches.
    reference_prior : tuple of float
        Prior of the statistic, which is that of the signature model.
    kept : CueingPolicies
        Policies whose risk maps are kept if there are no approaches.
    settings : CueingSettings, optional
        Budgets and sustained rule.

    Returns
    -------
    CueingCalibration
        Policies with the rates achieved on other folds.

    Raises
    ------
    InvalidArgumentError
        If there is no hazard-free window.

    Examples
    --------
    Ten artificial hazard-free recordings of one minute:

    >>> from worldstate.adapters.files.model_file import read_model
    >>> rng, kept = np.random.default_rng(0), read_model().policies
    >>> quiet = [
    ...     HopTable({"time_s": 0.1 * np.arange(600), "log_likelihoods": rng.normal(0.0, 1.0, (600, 4))})
    ...     for i in range(10)
    ... ]
    >>> found = calibrate_cueing(quiet, (0.25,) * 4, kept, CueingSettings(alphas=(0.05,)))
    >>> found.recordings, round(found.hours, 2), found.risk
    (10, 0.17, 'kept')
    """
    chosen = settings or CueingSettings()
    free = [stream for stream in streams if stream.hazard_free and len(stream)]
    if not free:
        raise InvalidArgumentError("recordings: expected at least one without a hazard")
    approaches = [stream for stream in streams if stream.before_sight().any()]
    budgets, policies = list[BudgetReport](), list[CueingPolicy]()
    for beta in sorted(MISS_RATES):
        calm = [statistic_at(stream, reference_prior, beta) for stream in free]
        hazards = [statistic_at(one, reference_prior, beta)[one.before_sight()] for one in approaches]
        nearest = min(kept.policies, key=lambda policy: abs(policy.miss_rate - beta))
        risk = _risk_map(calm, hazards) if hazards else nearest.risk_map
        for alpha in chosen.alphas:
            gamma, held_out = chosen.threshold(calm, alpha), _held_out(calm, alpha, chosen)
            budgets.append(BudgetReport(alpha, beta, gamma, _counted(calm, gamma, chosen), *held_out))
            policies.append(CueingPolicy(gamma, chosen.sustain_hops, alpha, reference_prior, risk, beta))
    tau = correlation_time_hops([statistic_at(stream, reference_prior, 0.0) for stream in free])
    fitted = "isotonic" if isinstance(policies[0].risk_map, IsotonicMap) else "platt"
    return CueingCalibration(
        policies=CueingPolicies(tuple(policies)),
        budgets=tuple(budgets),
        hours=budgets[0].counted.hours,
        windows=sum(map(len, free)),
        recordings=len(free),
        correlation_time_s=tau * HOP_S,
        risk=fitted if approaches else "kept",
        warnings=tuple(_warnings(budgets, len(free))),
    )


def statistic_at(stream: HopTable, prior: Sequence[float], miss_rate: float) -> FloatArray:
    r"""Return the statistic of every hop for an absence with a fixed miss rate, shape (n,).

    .. math:: s = \frac{\sum_k \pi_k \ell_k}
              {\sum_k \pi_k \ell_k + \beta\, \pi_{vis} \ell_{vis} + \pi_0 \ell_0}

    It is `abduction.evidence.statistic` with the same co-evidence at every hop.

    Shapes: prior (K + 2,).
    """
    with np.errstate(divide="ignore"):
        weighed = np.log(np.array([*prior[:-2], prior[-2] * miss_rate, prior[-1]]))
    joint = stream.log_likelihoods + weighed
    hidden, others = (np.logaddexp.reduce(part, axis=1) for part in (joint[:, :-2], joint[:, -2:]))
    return np.asarray(np.exp(-np.logaddexp(0.0, others - hidden)))


def _counted(calm: Sequence[FloatArray], gamma: float, settings: CueingSettings) -> ApproachTable:
    return ApproachTable([], [sustained_statistic(one, settings.sustain_hops) >= gamma for one in calm])


def _held_out(
    calm: list[FloatArray], alpha: float, settings: CueingSettings
) -> tuple[float, float] | tuple[None, None]:
    """Return the rates achieved over folds that do not split recordings."""
    folds = min(N_FOLDS, len(calm))
    if folds < 2:
        return None, None
    found = []
    for fold in range(folds):
        gamma = settings.threshold([s for i, s in enumerate(calm) if i % folds != fold], alpha)
        found.append(_counted(calm[fold::folds], gamma, settings))
    hours = sum(one.hours for one in found)
    shares = [float(np.mean(np.concatenate(one.hazard_free))) for one in found]
    share = sum(share * one.hours for share, one in zip(shares, found, strict=True)) / hours
    return share, sum(one.onsets for one in found) / hours


def _risk_map(calm: list[FloatArray], hazards: list[FloatArray]) -> RiskMap:
    scores = np.concatenate([*calm, *hazards])
    labels = np.arange(scores.size) >= sum(s.size for s in calm)
    return fit_risk_map(scores, labels, independent=scores.size / correlation_time_hops(calm))


def _warnings(budgets: list[BudgetReport], recordings: int) -> Iterator[str]:
    if few := caution(recordings):
        yield few
    for report in budgets:
        count = report.counted
        if report.miss_rate == 0.0 and count.onsets < ENOUGH_ONSETS:
            enough_h = count.hours * ENOUGH_ONSETS / max(count.onsets, 1)
            low, high = poisson_interval(count.onsets, count.hours)
            yield (
                f"alpha {report.alpha:g}: {count.onsets} false alarms in {count.hours:.3g} h put their rate "
                f"between {low:.3g} and {high:.3g} per hour; "
                f"{enough_h:.2g} h would determine it to a factor of two"
            )


def hop_streams(corpus: Path) -> Iterator[HopTable]:
    """Yield the hop streams of a corpus with the levels of the alarm; each recording is taken as hazard-free.

    Raises
    ------
    InputFileError
        If the corpus has no table of hops.
    """
    names = [name for name in (*STREAM_COLUMNS, "level_left", "level_right") if name != "there"]
    rows, about_of = corpus_rows(corpus, HeardHop), attrgetter("recording", "site", "signature")
    for (name, site, signature), hops in itertools.groupby(rows, key=about_of):
        columns = zip(*map(attrgetter(*names), hops), strict=True)
        table = dict(zip(names, map(np.array, columns), strict=True))
        # A hop without a level has None in this column.
        levels = {side: table[side].astype(float) for side in names[-2:]}
        about = {"site": site, "signature": signature}
        yield HopTable(table | levels | {"there": table["seen"]}, name=name, about=about)


def find_inputs(path: Path) -> list[Path]:
    """Return the recordings of a data set, or the given file or recording folder."""
    if not path.exists():
        raise InputFileError(path, "expected a data set, a recording folder or a sound file")
    if path.is_dir() and (path / LOG_NAME).is_file():
        return [recording.path for recording in OvadDataset(path).recordings]
    return [path]


def read_input(
    path: Path, *, array: MicrophoneArray | None = None, model: Path | None = None
) -> list[HopTable]:
    """Process a recording or read streams; a sound file is taken as hazard-free."""
    chosen = read_model(model, array=array)
    # Scores belong to one signature; thresholds of another signature cannot be set on them.
    about = {"signature": signature_checksum(chosen.signature)}
    if path.suffix == ".npz" or (path / "hops").is_dir():
        streams = load_streams(path) if path.is_file() else list(hop_streams(path))
        if not streams:
            raise InputFileError(path, "expected hops of sound: `worldstate hear --hops` writes them")
        if any(stream.about.get("signature", about["signature"]) != about["signature"] for stream in streams):
            raise OutOfDomainError(f"{path}: made with another model's signature; process the sound again")
        return streams
    source = open_source(path, array=array, model=chosen)
    measured = (measurement for _, measurement in measure_steps(source))
    if not path.is_dir():
        return [hop_stream(measured, name=str(path)).replace(about=about)]
    recording = Recording.open(path)
    name = "/".join(filter(None, (recording.environment, recording.recording_id)))
    stream = hop_stream(measured, name=name, label=recording.label or "none", t0_s=source.t0_s)
    return [stream.replace(about=about)]


def correlation_time_hops(streams: Sequence[ArrayLike]) -> float:
    r"""Return the integrated autocorrelation time of a statistic, in hops, >= 1.

    .. math:: \tau = 1 + 2 \sum_{j \ge 1} \rho_j,

    Shapes: streams (windows,).

    References
    ----------
    Geyer, "Practical Markov chain Monte Carlo", 1992.
    """
    # The sum ends at the first pair of neighbouring terms that is not positive (Geyer's initial positive
    # sequence). N windows determine the mean as well as N / tau independent ones.
    values = [finite_array("streams", stream, (None,)) for stream in streams]
    if not sum(value.size for value in values):
        raise InvalidArgumentError("streams: expected at least one window")
    correlation = _autocorrelation(values)
    pairs = correlation[: correlation.size // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0.0)
    last = int(negative[0]) if negative.size else pairs.size
    return float(max(2.0 * pairs[:last].sum() - 1.0, 1.0))


def _autocorrelation(values: list[FloatArray]) -> FloatArray:
    """Return the pooled autocorrelation up to half the longest stream, from lag 0."""
    mean = np.concatenate(values).mean()
    lags = max(value.size for value in values) // 2 + 2
    total, counts = np.zeros(lags), np.zeros(lags)
    for value in values:
        reach = min(lags, value.size)
        spectrum = np.fft.rfft(value - mean, 2 * value.size)
        total[:reach] += np.fft.irfft(np.abs(spectrum) ** 2, 2 * value.size)[:reach]
        counts[:reach] += value.size - np.arange(reach)
    covariance = np.divide(total, counts, out=np.zeros(lags), where=counts > 0)
    return covariance / covariance[0] if covariance[0] > 0.0 else np.zeros(lags)
