"""The paper's tables with its numbers and ours, and for each empty cell the reason."""

from dataclasses import dataclass

from splatgraft_paper.benchmark.table import Summary, Table, summarize
from splatgraft_paper.tables.layout import Kind
from splatgraft_paper.tables.paper_numbers import (
    DATA_ABLATION,
    ROTATION,
    SYNTHETIC,
    UPDATES,
    PublishedTable,
)
from splatgraft_paper.tables.run import PaperResults

_FORMATS = {"psnr": "{:.2f}", "fid": "{:.2f}", "minutes": "{:.1f}", "ssim": "{:.3f}", "lpips": "{:.3f}"}
_LESS_IS_BETTER = ("lpips", "fid", "kid", "flip", "minutes")
_KEYS = {"psnr": "psnr_whole", "ssim": "ssim_padded_whole", "lpips": "lpips_whole", "flip": "flip_whole"}
_COLUMNS = ("psnr", "ssim", "lpips", "fid", "kid", "flip")
_NO_TRUTH = ("object_brightness", "darkened_fraction", "brightened_fraction", "detail_kept", "rest_mean_change")
_NOT_REPEATED = "needs the paper's test splits and models trained without one source; the authors publish neither"
_NOT_PUBLISHED = "the paper's table has no such row"


@dataclass
class _Notes:
    """Reasons of the empty cells of one table, numbered."""

    reasons: list[str]

    def mark(self, reason: str) -> str:
        """The cell of an empty value."""
        if reason not in self.reasons:
            self.reasons.append(reason)
        return f"({self.reasons.index(reason) + 1})"


@dataclass(frozen=True)
class ExplainedTable:
    """A table, and the reasons of its empty cells by their numbers."""

    table: Table
    reasons: tuple[str, ...]

    def markdown(self) -> str:
        """Format it."""
        lines = ["| " + " | ".join(cells) + " |" for cells in (self.table.head, *self.table.rows)]
        lines.insert(1, "|" + " --- |" * len(self.table.head))
        notes = [f"({number}) {reason}" for number, reason in enumerate(self.reasons, 1)]
        return "\n".join([f"### {self.table.title}", "", *lines, "", *(f"- {note}" for note in notes)]).rstrip() + "\n"


def paper_tables(results: PaperResults) -> list[ExplainedTable]:
    """The paper's four tables, the real scenes without truth, and PSNR by scene."""
    return [
        _synthetic(results),
        _rotation(results),
        _data(),
        _updates(results),
        _without_truth(results),
        *_by_scene(results),
    ]


def _synthetic(results: PaperResults) -> ExplainedTable:
    notes = _Notes([])
    rows: list[tuple[str, ...]] = []
    names = list(dict.fromkeys([*SYNTHETIC.rows, *results.methods("synthetic")]))
    for name in names:
        if name in SYNTHETIC.rows:
            rows.append((f"{name}, as published", *_published(SYNTHETIC, name, notes)))
        what = "run here" if name in results.ours else "the authors' pictures, measured here"
        rows.append((f"{name}, {what}", *_measured(results, "synthetic", name, notes)))
    return ExplainedTable(Table(SYNTHETIC.title, _head("method"), tuple(rows)), tuple(notes.reasons))


def _rotation(results: PaperResults) -> ExplainedTable:
    notes = _Notes([])
    rows: list[tuple[str, ...]] = []
    methods = list(dict.fromkeys(["Ours", *results.methods("rotation")]))
    for pose in ROTATION.rows:
        rows.append((f"{pose}, as published", *_published(ROTATION, pose, notes)))
        for name in methods:
            what = "run here" if name in results.ours else "the authors' pictures, measured here"
            rows.append((f"{pose}, {name}, {what}", *_measured(results, "rotation", name, notes, pose=pose)))
    return ExplainedTable(Table(ROTATION.title, _head("pose"), tuple(rows)), tuple(notes.reasons))


def _data() -> ExplainedTable:
    notes = _Notes([])
    rows: list[tuple[str, ...]] = []
    for name, numbers in DATA_ABLATION.rows.items():
        cells = zip(DATA_ABLATION.columns, numbers, strict=True)
        rows.append((f"{name}, as published", *(_plain(column.split()[1], value) for column, value in cells)))
        rows.append((f"{name}, measured here", *(notes.mark(_NOT_REPEATED) for _ in DATA_ABLATION.columns)))
    head = ("model", *(f"{column.split()[0]} {_title(column.split()[1])}" for column in DATA_ABLATION.columns))
    return ExplainedTable(Table(DATA_ABLATION.title, head, tuple(rows)), tuple(notes.reasons))


def _updates(results: PaperResults) -> ExplainedTable:
    notes = _Notes([])
    rows: list[tuple[str, ...]] = []
    named = {"Ours": "once", "w/Linear": "linear", "w/Geometric": "geometric"}
    for name, schedule in named.items():
        rows.append((f"{name}, as published", *_published(UPDATES, name, notes, minutes=True)))
        cells = _measured(results, "synthetic", name, notes)
        no_time = notes.mark("a time on the authors' machine cannot be measured from pictures")
        rows.append((f"{name}, the authors' pictures, measured here", no_time, *cells))
        for method in results.ours:
            if "+" in method and (method.partition("@")[2] or "once") == schedule:
                minutes = _minutes(results, method) or notes.mark(results.reason("synthetic", method, "minutes"))
                cells = _measured(results, "synthetic", method, notes)
                rows.append((f"{method}, run here", minutes, *cells))
    head = _head("schedule")
    table = Table(UPDATES.title, (head[0], _title("minutes"), *head[1:]), tuple(rows))
    return ExplainedTable(table, tuple(notes.reasons))


def _without_truth(results: PaperResults) -> ExplainedTable:
    """Real scenes have no truth: what a method did to the composite (no table of the paper's)."""
    notes = _Notes([])
    rows: list[tuple[str, ...]] = []
    for name in results.methods("real"):
        found = results.of("real", name)
        cells: list[str] = []
        for metric in _NO_TRUTH:
            summary = summarize([item.values.get(metric) for item in found])
            reason = results.missing.get(_first_missing(results, "real", name), "needs the composite and masks")
            cells.append(notes.mark(reason) if summary is None else _cell(metric, summary))
        rows.append((name, str(len(found)), *cells))
    head = ("method", "scenes", *(name.replace("_", " ") for name in _NO_TRUTH))
    title = "Real scenes: what was done to the composite (they have no truth)"
    return ExplainedTable(Table(title, head, tuple(rows)), tuple(notes.reasons))


def _by_scene(results: PaperResults) -> list[ExplainedTable]:
    out: list[ExplainedTable] = []
    for kind in ("synthetic", "rotation"):
        scenes = [scene.name for scene in results.scenes if scene.kind == kind]
        notes = _Notes([])
        rows: list[tuple[str, ...]] = []
        for name in results.methods(kind):
            by_scene = {item.scene.name: item.values.get("psnr_whole") for item in results.of(kind, name)}
            cells: list[str] = []
            for scene in scenes:
                value = by_scene.get(scene)
                reason = results.missing.get((scene, name)) or f"no pictures of {name}, no truth, or equal to it"
                cells.append(notes.mark(reason) if value is None else _plain("psnr", value))
            rows.append((name, *cells))
        if rows and scenes:
            table = Table(f"PSNR by scene: {kind}", ("method", *scenes), tuple(rows))
            out.append(ExplainedTable(table, tuple(notes.reasons)))
    return out


def _head(first: str) -> tuple[str, ...]:
    return (first, *(_title(column) for column in _COLUMNS), "scenes")


def _title(metric: str) -> str:
    return f"{metric.upper() if metric != 'minutes' else metric} {'↓' if metric in _LESS_IS_BETTER else '↑'}"


def _published(table: PublishedTable, row: str, notes: _Notes, *, minutes: bool = False) -> list[str]:
    cells: list[str] = []
    for column in (*(("minutes",) if minutes else ()), *_COLUMNS):
        value = table.value(row, column)
        reason = _NOT_PUBLISHED if row not in table.rows else "not in the paper"
        cells.append(notes.mark(reason) if value is None else _plain(column, value))
    return [*cells, "3" if table is ROTATION else "9"]


def _measured(results: PaperResults, kind: Kind, method: str, notes: _Notes, *, pose: str = "") -> list[str]:
    found = results.of(kind, method, pose)
    with_truth = [item for item in found if "psnr_whole" in item.values]
    cells: list[str] = []
    for column in _COLUMNS:
        reason = results.reason(kind, method, "fid and kid" if column in ("fid", "kid") else column)
        if column in ("fid", "kid"):
            value = results.pooled.get((kind, pose, method), {}).get(column)
            cells.append(notes.mark(reason) if value is None else _plain(column, value))
            continue
        summary = summarize([item.values.get(_KEYS[column]) for item in with_truth])
        if summary is None and with_truth and column == "psnr":
            reason = "the pictures equal the truth: the ratio is infinite"
        cells.append(notes.mark(reason) if summary is None else _cell(column, summary))
    return [*cells, str(len(with_truth))]


def _minutes(results: PaperResults, method: str) -> str | None:
    found = [item.seconds for item in results.of("synthetic", method)]
    known = [sum(s.get(step, 0.0) for step in ("harmonize", "consolidate", "update")) for s in found if s]
    return _plain("minutes", sum(known) / len(known) / 60) if known else None


def _first_missing(results: PaperResults, kind: Kind, method: str) -> tuple[str, str]:
    names = [scene.name for scene in results.scenes if scene.kind == kind]
    return next(((name, method) for name in names if (name, method) in results.missing), ("", method))


def _plain(metric: str, value: float) -> str:
    return _FORMATS.get(metric, "{:.4f}").format(value)


def _cell(metric: str, found: Summary) -> str:
    if found.scenes == 1:
        return _plain(metric, found.mean)
    return f"{_plain(metric, found.mean)} [{_plain(metric, found.low)}, {_plain(metric, found.high)}]"
