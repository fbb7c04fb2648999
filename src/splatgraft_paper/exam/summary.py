"""Figures of a held-out benchmark over all its scenes, and its report in Markdown."""

from collections.abc import Sequence
from dataclasses import dataclass

from splatgraft_paper.exam.measure import LIGHT_ERRORS, METRICS, ROWS, SceneResult

_METRIC_TITLES = {
    "object": "PSNR of the object, dB",
    "whole": "PSNR of the whole image, dB",
    "shadow": "Error of the shadow (RMSE of the ratio of light with to light without the object)",
}
_LIGHT_TITLES = {
    "rms": "irradiance, RMS over normals, stops",
    "level": "its level, stops",
    "tint": "its tint, stops",
    "direction_deg": "direction of the highest irradiance, degrees",
}


@dataclass(frozen=True)
class RowSummary:
    """One row over all scenes on which it and pasting were measured; values are None without such a scene."""

    scenes: int
    object_gain: float | None
    """Mean gain of the object's PSNR over pasting, dB."""
    shadow_removed: float | None
    """Mean share of pasting's shadow error that is removed."""
    worse: int
    """Number of scenes whose whole image has a lower PSNR than pasting."""


@dataclass(frozen=True)
class Spread:
    """Mean and maximum of the absolute values of an error."""

    mean: float
    worst: float


def summarize_row(row: str, results: Sequence[SceneResult]) -> RowSummary:
    """Compare one row with pasting."""
    objects, wholes, shadows = (_beside_paste(row, results, metric) for metric in ("object", "whole", "shadow"))
    return RowSummary(
        scenes=len(wholes),
        object_gain=_mean([value - paste for value, paste in objects]),
        shadow_removed=_mean([1 - value / paste for value, paste in shadows]),
        worse=sum(value < paste for value, paste in wholes),
    )


def summarize_light(results: Sequence[SceneResult]) -> dict[str, Spread | None]:
    """Summarise errors of the light over all places, and errors of the ratio's level and of normals over all scenes."""
    places = [errors for r in results for errors in r.light.values() if errors is not None]
    out = {_LIGHT_TITLES[name]: _spread([errors[name] for errors in places]) for name in LIGHT_ERRORS}
    out["level of the ratio of new to old light, stops"] = _spread([r.ratio_level for r in results])
    out["normals, median of an object, degrees"] = _spread([r.normals_deg for r in results])
    return out


def summary_markdown(results: Sequence[SceneResult]) -> str:
    """Format tables with a line per scene, then the summary and the notes."""
    rows = [row for row in ROWS if any(row in r.rows for r in results)]
    parts = []
    for metric in METRICS:
        lines = [[r.name, *(_text(r.rows.get(row, {}).get(metric), metric) for row in rows)] for r in results]
        parts.append(f"## {_METRIC_TITLES[metric]}\n\n{_table(['scene', *rows], lines)}")
    parts.append(f"## Summary\n\n{_rows_table(rows, results)}\n\n{_spread_table(results)}")
    parts.append("## Notes\n\n" + "\n".join(f"- {r.name}: {note}" for r in results for note in r.notes))
    return "\n\n".join(parts) + "\n"


def _rows_table(rows: Sequence[str], results: Sequence[SceneResult]) -> str:
    lines = []
    for row in rows:
        found = summarize_row(row, results)
        share = "-" if found.shadow_removed is None else f"{found.shadow_removed:.0%}"
        gain = "-" if found.object_gain is None else f"{found.object_gain:+.2f}"
        lines.append([row, ROWS[row], gain, share, f"{found.worse} of {found.scenes}"])
    return _table(["row", "what it is", "object gain, dB", "shadow error removed", "scenes made worse"], lines)


def _spread_table(results: Sequence[SceneResult]) -> str:
    lines = []
    for title, found in summarize_light(results).items():
        lines.append([title, *(["-", "-"] if found is None else [f"{found.mean:.2f}", f"{found.worst:.2f}"])])
    return _table(["error of the estimate (absolute)", "mean", "worst"], lines)


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *lines))


def _text(value: float | None, name: str) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if name == "shadow" else f"{value:.1f}" if name == "direction_deg" else f"{value:.2f}"


def _beside_paste(row: str, results: Sequence[SceneResult], metric: str) -> list[tuple[float, float]]:
    """Pair the values of a row and of pasting, for the scenes that have both."""
    out = []
    for one in results:
        value, paste = (one.rows.get(name, {}).get(metric) for name in (row, "paste"))
        if value is not None and paste is not None:
            out.append((value, paste))
    return out


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _spread(values: Sequence[float | None]) -> Spread | None:
    known = [abs(value) for value in values if value is not None]
    return Spread(sum(known) / len(known), max(known)) if known else None
