"""Means, bootstrap intervals and Markdown tables of benchmark results per scene and method."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np

from splatgraft_paper.benchmark.measure import REGIONS

_RESAMPLES = 10_000  # resamples of the bootstrap
_FORMATS = {"psnr": "{:.2f}", "ssim": "{:.4f}", "flip": "{:.4f}", "lpips": "{:.4f}", "fid": "{:.1f}", "kid": "{:.4f}"}
_METRICS = ("psnr", "ssim", "flip", "lpips", "fid", "kid")
_LESS_IS_BETTER = (
    "flip", "lpips", "fid", "kid", "shadow_ratio_rmse", "disagreement", "rest_mean_change", "rest_max_change",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One method on one scene."""

    scene: str
    method: str
    values: Mapping[str, float | None]
    """Mean over held-out views by metric; None if it could not be measured."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall-clock seconds by step."""


@dataclass(frozen=True)
class Benchmark:
    """All results of a benchmark."""

    rows: tuple[Row, ...]
    """One row per scene and completed method."""
    not_run: tuple[str, ...]
    """One sentence per method that could not run."""
    not_measured: Mapping[str, str]
    """Reasons for empty columns by metric ("lpips", "fid and kid")."""
    notes: tuple[str, ...]
    """Conditions of the measurement: machine, sizes, numbers of views, commit, command."""
    pooled: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    """FID and KID by method, over the held-out views of all its scenes."""

    @property
    def methods(self) -> list[str]:
        """Names of methods in the order of their first row."""
        return list(dict.fromkeys(row.method for row in self.rows))

    @property
    def scenes(self) -> list[str]:
        """Names of scenes in the order of their first row."""
        return list(dict.fromkeys(row.scene for row in self.rows))


@dataclass(frozen=True)
class Summary:
    """A mean over scenes with its bootstrap interval."""

    mean: float
    """Mean over scenes with equal weights."""
    low: float
    """Percentile 2.5."""
    high: float
    """Percentile 97.5."""
    scenes: int
    """Number of scenes with a value."""


def metric_names() -> tuple[str, ...]:
    """List all metrics in the order of the tables."""
    by_region = [f"{metric}_{region}" for region in REGIONS for metric in _METRICS]
    return (*by_region, "shadow_ratio_rmse", "disagreement", "rest_mean_change", "rest_max_change")


def summarize(values: Sequence[float | None], *, seed: int = 0) -> Summary | None:
    """Compute the mean over scenes and its 95% percentile bootstrap interval (Efron 1979); None without any value.

    The interval is too narrow for few scenes; for one scene both ends are its value.
    """
    known = np.array([value for value in values if value is not None and math.isfinite(value)])
    if not len(known):
        return None
    picks = np.random.default_rng(seed).integers(0, len(known), (_RESAMPLES, len(known)))
    low, high = np.quantile(known[picks].mean(1), [0.025, 0.975])
    return Summary(mean=float(known.mean()), low=float(low), high=float(high), scenes=len(known))


def summaries(benchmark: Benchmark) -> dict[str, dict[str, Summary | None]]:
    """Summarise each metric by method; FID and KID pool the images of all scenes and have no interval."""
    out: dict[str, dict[str, Summary | None]] = {}
    for method in benchmark.methods:
        rows = [row for row in benchmark.rows if row.method == method]
        out[method] = {name: summarize([row.values.get(name) for row in rows]) for name in metric_names()}
        for name, value in benchmark.pooled.get(method, {}).items():
            out[method][name] = None if value is None else Summary(value, value, value, len(rows))
    return out


def as_json(benchmark: Benchmark) -> dict:
    """Convert everything to plain JSON values."""
    means = {
        method: {name: None if s is None else vars(s) for name, s in metrics.items()}
        for method, metrics in summaries(benchmark).items()
    }
    return {
        "means": means,
        "rows": [{**vars(row), "values": dict(row.values), "seconds": dict(row.seconds)} for row in benchmark.rows],
        "not_run": list(benchmark.not_run),
        "not_measured": dict(benchmark.not_measured),
        "notes": list(benchmark.notes),
    }


@dataclass(frozen=True)
class Table:
    """A table of text, for Markdown and HTML."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    """Conditions of the measurement, below the title."""

    def markdown(self) -> str:
        """Format the table with its title."""
        lines = ["| " + " | ".join(cells) + " |" for cells in (self.head, *self.rows)]
        lines.insert(1, "|" + " --- |" * len(self.head))
        note = f"{self.note}\n\n" if self.note else ""
        return f"### {self.title}\n\n{note}" + "\n".join(lines)


def tables(benchmark: Benchmark) -> list[Table]:
    """Make the tables: metrics by region, light, poses, time, and PSNR by scene."""
    means = summaries(benchmark)
    out = [_region_table(means, region, benchmark) for region in REGIONS]
    other = ("shadow_ratio_rmse", "disagreement", "rest_mean_change")
    rows = tuple((method, *(_cell(name, metrics[name]) for name in other)) for method, metrics in means.items())
    head = ("method", "shadow-ratio RMSE ↓", "disagreement of views ↓", "change of the rest ↓")
    out.append(Table("Light and consistency", head, rows))
    out += _pose_tables(benchmark)
    out.append(_cost_table(benchmark))
    for region in ("object", "shadow", "whole"):
        per_scene = tuple(
            (method, *(_plain(f"psnr_{region}", _value(benchmark, scene, method, f"psnr_{region}"))
                       for scene in benchmark.scenes))
            for method in benchmark.methods
        )  # fmt: skip
        out.append(Table(f"PSNR by scene: {region}", ("method", *benchmark.scenes), per_scene))
    return out


def markdown(benchmark: Benchmark) -> str:
    """Format all tables and notes as Markdown."""
    parts = [table.markdown() for table in tables(benchmark)]
    notes = [f"- {note}" for note in (*benchmark.notes, *benchmark.not_run, *_missing(benchmark))]
    return "\n\n".join([*parts, "\n".join(notes)]) + "\n"


def _missing(benchmark: Benchmark) -> list[str]:
    return [f"Not measured: {name}: {reason}" for name, reason in benchmark.not_measured.items()]


def _region_table(means: dict[str, dict[str, Summary | None]], region: str, benchmark: Benchmark) -> Table:
    head = ("method", *(f"{m.upper()} {'↓' if m in _LESS_IS_BETTER else '↑'}" for m in _METRICS))
    rows = []
    for method, found in means.items():
        cells = [
            _cell(f"{m}_{region}", found[f"{m}_{region}"], any(m in name.split() for name in benchmark.not_measured))
            for m in _METRICS
        ]
        rows.append((method, *cells))
    titles = {"whole": "Whole image", "object": "Object", "shadow": "Shadow band", "rest": "Untouched rest"}
    return Table(titles[region], head, tuple(rows))


def _pose_tables(benchmark: Benchmark) -> list[Table]:
    """Make the table of means by pose of the object, for scenes with rotations (paper, illumination consistency)."""
    poses: dict[str, list[str]] = {}
    for scene in benchmark.scenes:
        if match := re.fullmatch(r".+_(p\d)", scene):
            poses.setdefault(match[1], []).append(scene)
    if not poses:
        return []
    names = ("psnr_whole", "psnr_object", "psnr_shadow", "shadow_ratio_rmse")
    rows = []
    for method in benchmark.methods:
        for pose, scenes in sorted(poses.items()):
            found = (summarize([_value(benchmark, scene, method, name) for scene in scenes]) for name in names)
            cells = (_cell(name, value) for name, value in zip(names, found, strict=True))
            rows.append((f"{method}, {pose.upper()}", *cells))
    head = ("method, pose", "PSNR ↑", "object PSNR ↑", "shadow PSNR ↑", "shadow-ratio RMSE ↓")
    return [Table("The object at several rotations", head, tuple(rows))]


def _cost_table(benchmark: Benchmark) -> Table:
    steps = list(dict.fromkeys(step for row in benchmark.rows for step in row.seconds))
    rows = []
    for method in benchmark.methods:
        found = [row.seconds for row in benchmark.rows if row.method == method]
        cells = []
        for step in steps:
            known = [seconds[step] for seconds in found if step in seconds]
            cells.append(f"{sum(known) / len(known):.1f}" if known else "")
        rows.append((method, *cells))
    return Table("Seconds per scene and step", ("method", *steps), tuple(rows))


def _value(benchmark: Benchmark, scene: str, method: str, name: str) -> float | None:
    return next((row.values.get(name) for row in benchmark.rows if (row.scene, row.method) == (scene, method)), None)


def _plain(name: str, value: float | None) -> str:
    form = _FORMATS.get(name.split("_", maxsplit=1)[0], "{:.4f}")
    return "" if value is None or not math.isfinite(value) else form.format(value)


def _cell(name: str, found: Summary | None, missing: bool = False) -> str:
    if found is None:
        return "not measured" if missing else ""
    if found.scenes == 1 or found.low == found.high:
        return _plain(name, found.mean)
    return f"{_plain(name, found.mean)} [{_plain(name, found.low)}, {_plain(name, found.high)}]"


def table_section(table: Table) -> str:
    """Format one table with its title as HTML."""
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table.head)
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th>' + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"
        for name, *cells in table.rows
    )
    note = f"<p>{escape(table.note)}</p>" if table.note else ""
    return (
        f'<section><h2>{escape(table.title)}</h2>{note}<div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div></section>\n"
    )
