"""Every figure of an evaluation: its title with the unit, its decimals, and how it is counted."""

from typing import Literal, NamedTuple

import numpy as np

from worldstate.operations.metrics.approach_table import SECONDS_PER_HOUR
from worldstate.operations.recordings.hop_stream import HOP_S


class FigureKind(NamedTuple):
    """What is printed of a figure, and the ratio of sums over recordings that it is, where it is one."""

    title: str
    # Decimals that the numbers of recordings at hand can bear.
    digits: int = 2
    worse: Literal["low", "high", ""] = ""  # The worse end, where junctions are compared
    counts: tuple[str, str] | None = None  # See `reduction`
    unit: float = 1.0

    @property
    def words(self) -> str:
        """The title without its unit."""
        return self.title.partition(" (")[0]


_PER_HOUR = 1.0 / (HOP_S / SECONDS_PER_HOUR)  # Of counts a hop
_DEG = float(np.degrees(1.0))
# A mean of the rates of single recordings would let one of ten seconds weigh as much as a stream of an hour:
# a figure is a ratio of sums. Those a recording are the challenge's: each with a vehicle in view counts once.
FIGURES: dict[str, FigureKind] = {
    "detection": FigureKind("detected (share)", 2, "low", ("detected", "approaches")),
    "lead_s": FigureKind("lead (s)", 2, "low", ("lead_s", "detected")),
    "lead_missed_zero_s": FigureKind("lead, missed = 0 (s)", 2, "low", ("lead_s", "approaches")),
    "early_onsets_per_approach": FigureKind(
        "onsets > 5 s early (per approach)", 2, "high", ("early_onsets", "approaches")
    ),
    "side_correct": FigureKind("right side (share)", 2, "low", ("side_right", "sided")),
    "false_alarms_per_hour": FigureKind(
        "false alarms (1/h)", 0, "high", ("free_onsets", "free_hops"), _PER_HOUR
    ),
    "advisory_share": FigureKind(
        "hazard-free time in advisory (share)", 3, "high", ("free_alarm_hops", "free_hops")
    ),
    "hazard_awareness": FigureKind("hazard awareness (share)", 2, "low", ("aware_hops", "clear_hops")),
    "id_switches_per_recording": FigureKind(
        "identity switches (per recording)", 2, "high", ("id_switches", "tracked")
    ),
    "fragmentations_per_recording": FigureKind(
        "fragmentations (per recording)", 2, "high", ("fragmentations", "tracked")
    ),
    "swap_rate_hz": FigureKind("swap rate (1/s)", 2, "high", ("swap_rate_hz", "tracked")),
    "fragmentation_rate_hz": FigureKind(
        "fragmentation rate (1/s)", 2, "high", ("fragmentation_rate_hz", "tracked")
    ),
    "track_latency_s": FigureKind("track latency (s)", 2, "high", ("track_latency_s", "tracked")),
    "azimuth_error_deg": FigureKind("azimuth error (deg)", 1, "high", ("azimuth_error_rad", "matched"), _DEG),
    "gospa_deg": FigureKind("GOSPA, 60 deg (deg)", 1, "high", ("gospa_rad", "gospa_hops"), _DEG),
    "visible_coverage": FigureKind(
        "its interval covers (share)", 2, "low", ("visible_inside", "visible_intervals")
    ),
    "visible_error_s": FigureKind("time to visible, RMSE (s)", 2, "high"),
    "visible_error_constant_s": FigureKind("best constant (s)"),
    "random_detection": FigureKind("random alarms detect (share)"),
    "hazard_free_hours": FigureKind("hazard-free time (h)", 3),
    "quantum_per_hour": FigureKind("one alarm onset (1/h)", 1),
    "false_onsets": FigureKind("false onsets", 1),
    "auroc_all": FigureKind("AUROC, all before T0", 3, "low"),
    "auroc_2s": FigureKind("AUROC, last 2 s", 3, "low"),
    "auroc_1s": FigureKind("AUROC, last 1 s", 3, "low"),
    "ece": FigureKind("ECE", 3),
    "ece_floor": FigureKind("its sampling floor", 3),
    "ece_raw": FigureKind("ECE, raw", 3),
    "brier_skill": FigureKind("Brier skill", 3, "low"),
    "hazard_share": FigureKind("hazard windows (share)", 3),
    "bearing_deg": FigureKind("bearing error in view (deg)", 1, "high"),
    "bearing_gated_deg": FigureKind("bearing error, gated (deg)", 1, "high"),
    "bearing_music_deg": FigureKind("bearing error of MUSIC (deg)", 1),
    "bearing_best_site_deg": FigureKind("bearing error, best junction (deg)", 1),
    "bearing_worst_site_deg": FigureKind("bearing error, worst junction (deg)", 1),
    "gated_coverage": FigureKind("share kept by the gate"),
    "prominence_in_view": FigureKind("prominence in view"),
    "prominence_in_silence": FigureKind("prominence, hazard-free"),
    "detection_least": FigureKind("detected, least (share)"),
    "detection_most": FigureKind("detected, most (share)"),
    "detection_worst": FigureKind("detected, worst junction (share)"),
    "detection_best": FigureKind("detected, best junction (share)"),
    "approaches_with_early_box": FigureKind("approaches with a box before T0", 0),
    "t0_s": FigureKind("T0 (s)"),
    "fewer_false_alarms": FigureKind("false alarms saved (share)"),
    "pass_bys": FigureKind("approaches", 0),
    "doppler_usable": FigureKind("with a usable tone", 0),
    "doppler_speed_km_h": FigureKind("speed read from it (km/h)"),
    "looming_correlation": FigureKind("correlation with the true time"),
    "looming_auroc": FigureKind("AUROC, last 3 s", 3),
    "frames": FigureKind("frames", 0),
    "recordings": FigureKind("recordings", 0),
    "beta_boresight_clean": FigureKind("clean, at boresight"),
    "beta_20_30_deg": FigureKind("clean, 20 to 30 deg"),
    "beta_harshest": FigureKind("harshest noise"),
    "beta_clean": FigureKind("clean, all angles"),
    "beta_clean_large": FigureKind("clean, all angles, other detector"),
    "awareness_least": FigureKind("least hazard awareness"),
    "vision_least": FigureKind("least of vision alone"),
}
