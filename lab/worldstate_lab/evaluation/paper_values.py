"""Every number that the paper states in its sections IV, VII, VIII and IX, and what it takes to fill it."""

import math
from dataclasses import dataclass
from typing import Literal

# What a number stands on: the positions of the microphones, this machine, OVAD's sound and video, the sound
# of the two roadside corpora; "stated" is said of the data or the setting and is not an outcome.
Basis = Literal["array", "machine", "ovad", "corpora", "stated"]
COMMANDS: dict[Basis, str] = {
    "array": "worldstate array bounds",
    "machine": "worldstate-lab bench",
    "ovad": "worldstate-lab table OVAD --out DIR",
    "corpora": "worldstate-lab corpora --idmt IDMT --melaudis MELAUDIS --out DIR",
    "stated": "",
}


@dataclass(frozen=True, slots=True)
class PaperValue:
    """One number of the paper: where it stands, what it means, and its interval if the paper gives one."""

    section: str
    group: str  # Name of the protocol, or part of the paper
    row: str  # Method, or condition
    figure: str  # As `Score.figures` names it, where it does
    value: float
    unit: str = ""
    low: float = math.nan
    high: float = math.nan
    basis: Basis = "ovad"

    @property
    def command(self) -> str:
        """What fills it; empty where nothing is to be measured."""
        return COMMANDS[self.basis]

    @property
    def digits(self) -> int:
        """Decimals with which the paper prints it, such as 3 of 0.881 and 2 of 0.70."""
        stated = len(f"{self.value:.10g}".partition(".")[2])
        # A float keeps no trailing zero; shares and areas have two decimals everywhere in the paper.
        return max(stated, 2) if stated and self.unit in ("share", "") else stated


_NAN = math.nan
# The text says .881 where Table I prints .88; both are 37 of 42.
_TABLE_I = (
    ("Vision-only", 0.0, 0.0, 0.0, _NAN),
    ("Radar field-of-view model", 0.0, 0.0, _NAN, _NAN),
    ("OC-SORT recovery (stock)", 0.0, 0.0, _NAN, _NAN),
    ("published", 2.29, 1.0, 350.0, _NAN),
    ("published, sustained", 1.88, 0.88, 185.0, _NAN),
    ("proposed .02", 1.69, 0.881, 107.0, 3.4),
    ("proposed .05", 2.15, 0.93, 262.0, 3.4),
)  # fmt: skip
_BOOTSTRAP = {
    ("proposed .02", "detection"): (0.79, 0.98),
    ("proposed .02", "lead_s"): (1.30, 2.08),
    ("proposed .02", "false_alarms_per_hour"): (19.0, 214.0),
}
UNITS = {"lead_s": "s", "detection": "share", "false_alarms_per_hour": "1/h", "bearing_deg": "deg"}


def _table_i() -> list[PaperValue]:
    return [
        PaperValue("IX", "static", row, figure, value, unit, *_BOOTSTRAP.get((row, figure), (_NAN, _NAN)))
        for row, *values in _TABLE_I
        for (figure, unit), value in zip(UNITS.items(), values, strict=True)
        if not math.isnan(value)
    ]


def _values(section: str, group: str, row: str, *figures: tuple[str, float, str]) -> list[PaperValue]:
    return [PaperValue(section, group, row, *figure) for figure in figures]


def _of(basis: Basis, section: str, group: str, *rows: tuple[str, str, float, str]) -> list[PaperValue]:
    return [PaperValue(section, group, *row, basis=basis) for row in rows]


PAPER_VALUES: tuple[PaperValue, ...] = (
    *_of(
        "array", "IV", "array bounds",
        ("horizontal moment S_xx", "horizontal_moment_m2", 3.03, "m^2"),
        ("bearing bound times sqrt(2 N SNR), 1 kHz, broadside", "sigma_deg", 1.8, "deg"),
        ("mean distance of neighbouring microphones", "mean_spacing_m", 0.088, "m"),
        ("alias-free up to", "alias_hz", 1900.0, "Hz"),
        ("aperture, horizontal", "aperture_width_m", 0.78, "m"),
        ("aperture, vertical", "aperture_height_m", 0.65, "m"),
        ("microphones", "microphones", 56.0, ""),
    ),
    *_of(
        "corpora", "IV", "signature study",
        ("Fisher profile, lower end of the peak", "fisher_low_hz", 300.0, "Hz"),
        ("Fisher profile, upper end of the peak", "fisher_high_hz", 1800.0, "Hz"),
    ),
    *_values("VII", "static", "proposed .01", ("false_alarms_per_hour", 58.0, "1/h")),
    *_values(
        "VII", "static", "proposed .02",
        ("ece", 0.034, ""), ("ece_raw", 0.167, ""),
        ("hazard_free_hours", 0.103, "h"), ("quantum_per_hour", 9.7, "1/h"),
    ),
    *_of(
        "stated", "VIII", "data",
        ("folds", "folds", 5.0, ""),
        ("nominal sample rate", "nominal_rate_hz", 48_000.0, "Hz"),
        ("effective sample rate", "sample_rate_hz", 47_998.0, "Hz"),
        ("bits a sample", "sample_bits", 24.0, ""),
        ("junctions", "junctions", 5.0, ""),
        ("static test recordings", "recordings", 83.0, ""),
        ("of them occluded approaches", "approaches", 42.0, ""),
        ("of them hazard-free", "hazard_free_recordings", 41.0, ""),
        ("dynamic test recordings", "dynamic_recordings", 59.0, ""),
    ),
    *_of(
        "machine", "IX", "real time",
        ("whole chain, 0.1-s hop", "hop_s", 0.106, "s"),
        ("of it the 56-channel STFT", "stft_s", 0.045, "s"),
        ("seconds of sound a second", "realtime_factor", 0.9, ""),
    ),
    *_table_i(),
    *_values(
        "IX", "static", "proposed .02",
        ("auroc_all", 0.70, ""), ("auroc_2s", 0.87, ""), ("auroc_1s", 0.92, ""),
    ),
    *_values("IX", "static", "Vision-only", ("approaches_with_early_box", 3.0, "of 42")),
    *_values(
        "IX", "static", "proposed .02, least and most over five seeds",
        ("detection_least", 0.81, "share"), ("detection_most", 0.91, "share"),
    ),
    *_values("IX", "static", "against the sustained rule", ("fewer_false_alarms", 0.42, "share")),
    *_values("IX", "timeline", "one approach", ("lead_s", 2.3, "s"), ("t0_s", 7.0, "s")),
    *_values(
        "IX", "front-end", "bearing in view",
        ("frames", 990.0, ""), ("recordings", 42.0, ""), ("bearing_deg", 3.4, "deg"),
        ("bearing_best_site_deg", 2.5, "deg"), ("bearing_worst_site_deg", 5.8, "deg"),
        ("bearing_music_deg", 7.1, "deg"), ("bearing_gated_deg", 2.4, "deg"),
        ("gated_coverage", 0.16, "share"), ("prominence_in_view", 1.60, ""),
        ("prominence_in_silence", 1.18, ""),
    ),
    *_values(
        "IX", "approach rate", "Doppler",
        ("pass_bys", 41.0, ""), ("doppler_usable", 1.0, "of 41"), ("doppler_speed_km_h", 25.0, "km/h"),
    ),
    *_values(
        "IX", "approach rate", "looming",
        ("looming_correlation", 0.07, ""), ("looming_auroc", 0.735, ""),
    ),
    *_values(
        "IX", "static", "proposed .02 + looming",
        ("detection", 0.905, "share"), ("false_alarms_per_hour", 117.0, "1/h"),
    ),
    *_of(
        "corpora", "IX", "signature study",
        ("studio microphones", "auroc_studio", 0.999, ""),
        ("MEMS microphones", "auroc_mems", 0.997, ""),
        ("level-free shape, lowest", "auroc_shape_least", 0.76, ""),
        ("level-free shape, highest", "auroc_shape_most", 0.90, ""),
    ),
    *_values(
        "IX", "degradation", "miss rate of the camera",
        ("beta_boresight_clean", 0.04, ""), ("beta_20_30_deg", 0.14, ""), ("beta_harshest", 0.97, ""),
        ("beta_clean", 0.07, ""), ("beta_clean_large", 0.04, ""),
    ),
    *_values(
        "IX", "degradation", "after line-of-sight entry",
        ("awareness_least", 0.87, "share"), ("vision_least", 0.03, "share"),
    ),
    *_values(
        "IX", "junctions_fixed", "proposed .02",
        ("detection", 0.857, "share"), ("false_alarms_per_hour", 97.0, "1/h"),
    ),
    *_values(
        "IX", "junctions_retrained", "proposed .02",
        ("detection", 0.762, "share"), ("false_alarms_per_hour", 282.0, "1/h"),
        ("detection_worst", 0.167, "share"), ("detection_best", 1.0, "share"),
    ),
    *_values("IX", "dynamic", "published", ("detection", 0.97, "share")),
    *_values("IX", "dynamic", "published", ("false_alarms_per_hour", 1660.0, "1/h")),
    *_values("IX", "dynamic", "proposed .02", ("auroc_all", 0.56, ""), ("detection", 0.29, "share")),
    *_of(
        "stated", "IX", "approach rate",
        ("engine speed, spread during an approach", "rpm_spread", 0.05, "share"),
        ("Doppler shift at 30 km/h, at least", "doppler_shift_least", 0.02, "share"),
        ("Doppler shift at 30 km/h, at most", "doppler_shift_most", 0.03, "share"),
    ),
    *_values("IX", "ablations", "raw statistic", ("ece", 0.167, "")),
    *_values("IX", "ablations", "calibrated risk", ("ece", 0.034, "")),
)  # fmt: skip
_BY_NAME = {(one.group, one.row, one.figure): one for one in PAPER_VALUES}


def paper_value(group: str, row: str, figure: str) -> PaperValue | None:
    """Return what the paper states there, None where it states nothing.

    Examples
    --------
    >>> paper_value("static", "proposed .02", "lead_s").value
    1.69
    """
    return _BY_NAME.get((group, row, figure))
