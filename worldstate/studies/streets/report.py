"""Figures of simulated recordings beside the paper's: one table, one JSON object."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Judged = Literal["within", "relative", "conclusion", "set", "shown"]
RELATIVE = 0.2


@dataclass(frozen=True, slots=True)
class Target:
    """A published figure and how near the simulated one should come to it.

    Examples
    --------
    >>> target = Target("lead, s", 2.29, "relative")
    >>> target.agrees(2.0), target.agrees(1.0), target.agrees(float("nan"))
    (True, False, False)
    """

    label: str  # For people
    published: float  # The paper's value
    # "within" an absolute tolerance, "relative" within 20 %, same "conclusion" (on the same side of a
    # bound), "set" to it by the free knob, or "shown" only.
    judged: Judged
    bound: float = 0.0  # The tolerance, or the bound of the conclusion
    counts: bool = True  # Whether it is among the thirteen of which eight should agree

    def agrees(self, value: float) -> bool | None:
        """Whether a value comes near enough; None where it is only shown."""
        if self.judged == "shown":
            return None
        if self.judged == "conclusion":
            return abs(value) < self.bound and abs(self.published) < self.bound
        allowed = self.bound if self.judged == "within" else RELATIVE * abs(self.published)
        return abs(value - self.published) <= allowed + 1e-9


TARGETS: Mapping[str, Target] = {
    "auroc_all": Target("window AUROC, all occluded", 0.70, "shown", counts=False),
    "auroc_2s": Target("window AUROC, <= 2 s to T0", 0.87, "within", 0.05, counts=False),
    "auroc_1s": Target("window AUROC, <= 1 s to T0", 0.92, "within", 0.05, counts=False),
    "vision_detection": Target("vision alone, detection", 0.0, "shown", counts=False),
    "vision_lead_s": Target("vision alone, lead, s", 0.0, "shown", counts=False),
    "vision_false_alarms_per_hour": Target("vision alone, FA/h", 0.0, "shown", counts=False),
    "published_detection": Target("published rule, detection", 1.00, "relative"),
    "published_lead_s": Target("published rule, lead, s", 2.29, "relative"),
    "published_false_alarms_per_hour": Target("published rule, FA/h (knob)", 350.0, "set"),
    "sustained_detection": Target("sustained rule, detection", 0.88, "relative"),
    "sustained_lead_s": Target("sustained rule, lead, s", 1.88, "relative"),
    "sustained_false_alarms_per_hour": Target("sustained rule, FA/h", 185.0, "relative"),
    "bearing_srp_deg": Target("bearing in view, SRP, deg", 3.4, "relative"),
    "bearing_gated_deg": Target("SRP, most prominent 16 %, deg", 2.4, "relative", counts=False),
    "bearing_music_deg": Target("bearing in view, MUSIC, deg", 7.1, "relative"),
    "prominence_in_view": Target("prominence in view", 1.60, "relative"),
    "prominence_in_silence": Target("prominence in silence", 1.18, "relative"),
    "looming_auroc": Target("looming AUROC, < 3 s to pass", 0.735, "within", 0.06),
    "looming_correlation": Target("looming time vs true, r", 0.07, "conclusion", 0.3),
    "doppler_share": Target("usable tonal Doppler, share", 1.0 / 41.0, "conclusion", 0.1),
    "ours_detection": Target("ours (alpha .02), detection", 0.88, "shown", counts=False),
    "ours_lead_s": Target("ours (alpha .02), lead, s", 1.69, "shown", counts=False),
    "ours_false_alarms_per_hour": Target("ours (alpha .02), FA/h", 107.0, "shown", counts=False),
    "ours_loose_detection": Target("ours (alpha .05), detection", 0.93, "shown", counts=False),
    "ours_loose_lead_s": Target("ours (alpha .05), lead, s", 2.15, "shown", counts=False),
    "ours_loose_false_alarms_per_hour": Target("ours (alpha .05), FA/h", 262.0, "shown", counts=False),
    "ece_calibrated": Target("ECE of calibrated risk", 0.034, "shown", counts=False),
    "ece_raw": Target("ECE of raw statistic", 0.167, "shown", counts=False),
}


def comparison_report(
    figures: Mapping[str, float], intervals: Mapping[str, tuple[float, float]]
) -> dict[str, object]:
    """Return the figures beside the published ones as JSON-able values; unknown is None."""
    rows: dict[str, dict[str, object]] = {}
    for name, target in TARGETS.items():
        value, (low, high) = figures[name], intervals[name]
        rows[name] = {
            "label": target.label,
            "value": _known(value),
            "low": _known(low),
            "high": _known(high),
            "published": target.published,
            "judged": target.judged,
            "agrees": target.agrees(value),
        }
    counted = [name for name, target in TARGETS.items() if target.counts]
    agreeing = [name for name in counted if rows[name]["agrees"]]
    return {
        "figures": rows,
        "judged": len(counted),
        "agreeing": len(agreeing),
        "outside": [name for name in counted if name not in agreeing],
    }


def comparison_table(report: Mapping[str, object]) -> str:
    """Return the table for people, one line a figure."""
    rows = report["figures"]
    assert isinstance(rows, dict)
    lines = [f"{'':<30} {'twin':>6}  {'95 % over recordings':<18} {'paper':>7}  near"]
    for row in rows.values():
        interval = f"[{_short(row['low'])}, {_short(row['high'])}]"
        near = {None: "-", True: "yes", False: "no"}[row["agrees"]]
        published = _short(row["published"])
        lines.append(f"{row['label']:<30} {_short(row['value']):>6}  {interval:<18} {published:>7}  {near}")
    lines.append(f"{report['agreeing']} of {report['judged']} near the paper")
    return "\n".join(lines)


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
