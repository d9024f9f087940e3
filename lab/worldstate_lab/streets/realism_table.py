"""The comparison of simulated with real windows as lines for people."""

from collections.abc import Mapping

from .asked import Span
from .realism import Realism
from .realism_rows import RealismRow
from .side import FAR_AZIMUTHS_DEG


def realism_lines(found: Realism) -> list[str]:
    """Return figures, transfers and profiles; `!` marks what is outside, `x` what is not as asked."""
    names = list(dict.fromkeys(name for row in found.rows for name in row.simulated))
    lines = [f"real against real: {'; '.join(found.groupings)}", _head(names)]
    lines += [_line(row, names) for row in found.rows]
    for name in names:
        inside, met = ([how.get(name) for how in told] for told in _verdicts(found))
        lines.append(
            f"{name}: inside {inside.count(True)}, outside {inside.count(False)}; "
            f"as asked {met.count(True)}, not {met.count(False)}"
        )
    for name, one in found.transfers.items():
        low, high = one.gain or (float("nan"),) * 2
        lines.append(
            f"{name}: AUROC {one.auroc:.3f}, loudest direction {one.scalar:.3f}, "
            f"gain [{low:+.3f}, {high:+.3f}], {one.windows} windows"
        )
    return lines + _profile_lines(found.profiles)


def _verdicts(found: Realism) -> tuple[list[dict[str, bool | None]], list[dict[str, bool | None]]]:
    return [row.inside for row in found.rows], [row.met for row in found.rows]


def _head(names: list[str]) -> str:
    spans = f"{'real against real':>19}{'of a type':>13}{'asked':>13}"
    return f"{'figure':<53}{'windows':<14}{'real':>8}{spans}" + "".join(
        f"{name[-10:]:>11}  " for name in names
    )


def _line(row: RealismRow, names: list[str]) -> str:
    columns = "".join(f"{_number(row.simulated.get(name)):>11}{_marks(row, name):<2}" for name in names)
    spans = f"{_span(row.halves):>19}{_span(row.junctions):>13}{_span(row.asked):>13}"
    return f"{row.figure:<53}{row.windows:<14}{_number(row.real):>8}{spans}{columns}"


def _marks(row: RealismRow, name: str) -> str:
    return "!" * (row.inside.get(name) is False) + "x" * (row.met.get(name) is False)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _span(span: Span | None) -> str:
    return "-" if span is None else f"{span[0]:.3f}-{span[1]:.3f}"


def _profile_lines(profiles: Mapping[str, Mapping[str, tuple[tuple[float, ...], ...]]]) -> list[str]:
    azimuths = "".join(f"{azimuth:6.0f}" for azimuth in FAR_AZIMUTHS_DEG)
    lines = [
        "",
        "louder on the far side than on the vehicle's own (odd part, log), by azimuth in deg",
        f"{'':<26}{azimuths}",
    ]
    for site in sorted({site for by_site in profiles.values() for site in by_site}):
        for half in range(2):
            for name, by_site in profiles.items():
                if site in by_site:
                    values = "".join(f"{value:+6.2f}" for value in by_site[site][half])
                    lines.append(f"{site:<5}half {half + 1:<3}{name[-12:]:<13}{values}")
    return lines
