"""The paper's tables and figures with published and measured numbers, as Markdown, JSON and a page."""

import json
import shlex
import sys
from collections.abc import Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import read_rgb, resize, write_image
from splatgraft.evaluation import side_by_side
from splatgraft.evaluation.report_page import html_page
from splatgraft.runtime.process import source_commit
from splatgraft_paper.benchmark.table import Table, summarize, table_section
from splatgraft_paper.tables.layout import Kind, PaperScene, held_out_stems, match_views, pictures
from splatgraft_paper.tables.paper_numbers import (
    COST,
    DATA,
    LISTED,
    ROTATION,
    SCENES,
    SYNTHETIC,
    UPDATES,
    PublishedTable,
)
from splatgraft_paper.tables.run import METRIC_VERSIONS, PaperResults

_FORMATS = {"psnr": "{:.2f}", "fid": "{:.2f}", "minutes": "{:.2f}", "ssim": "{:.3f}", "lpips": "{:.3f}"}
_LESS_IS_BETTER = ("lpips", "fid", "kid", "flip", "minutes")
_COLUMNS = ("psnr", "ssim", "lpips", "fid", "kid", "flip")
_EMPTY = "–"  # cell without a number; the notes give the reason
_FIGURES: dict[Kind, tuple[str, ...]] = {
    "synthetic": ("composite", "GS-IR", "GShader", "3DGS-DR", "Ours", "truth"),
    "real": ("background", "composite", "GS-IR", "GShader", "3DGS-DR", "Ours"),
    "rotation": ("composite", "Ours", "truth"),
}
"""Columns of the paper's figures of 3D results; our methods are inserted before the last."""
_ROW_HEIGHT = 200  # height of a picture in a figure, pixels


def write_paper_report(out: Path, results: PaperResults) -> Path:
    """Write index.html, paper.md, paper.json and figures/, and return the page."""
    tables, notes, figures = paper_tables(results), protocol_notes(results), _figures(out, results)
    shown = [f"![{path.stem}]({path.relative_to(out).as_posix()})" for path in figures]
    text = [*(table.markdown() for table in tables), *shown, "\n".join(f"- {note}" for note in notes)]
    out.mkdir(parents=True, exist_ok=True)
    (out / "paper.md").write_text("\n\n".join(text) + "\n", encoding="utf-8")
    (out / "paper.json").write_text(json.dumps(_as_json(results, notes), indent=1, allow_nan=False), encoding="utf-8")
    images = "".join(
        f'<section><h2>Figure: {path.stem}</h2><img src="{path.relative_to(out).as_posix()}" alt="{path.stem}" '
        f'style="max-width:100%"></section>'
        for path in figures
    )
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    body = "".join(map(table_section, tables)) + images
    body += f"<section><h2>Protocol</h2><ul>{items}</ul></section>"
    page = out / "index.html"
    page.write_text(
        html_page("The paper's tables", "Published numbers beside those measured here.", body, views=()),
        encoding="utf-8",
    )
    return page


def paper_tables(results: PaperResults) -> list[Table]:
    """Make the paper's four tables, its ablation of the loss, its costs, and PSNR by scene."""

    def title(metric: str) -> str:
        return f"{_metric(metric, results)} {'↓' if metric in _LESS_IS_BETTER else '↑'}"

    synthetic: list[tuple[str, ...]] = []
    for name in dict.fromkeys([*SYNTHETIC.rows, *results.methods("synthetic")]):
        if name in SYNTHETIC.rows:
            synthetic.append((f"{name}, as published", *_published(SYNTHETIC, name, _COLUMNS)))
        synthetic.append((_named(name, results), *_measured(results, "synthetic", name)))
    rotation: list[tuple[str, ...]] = []
    for pose in ROTATION.rows:
        rotation.append((f"{pose}, as published", *_published(ROTATION, pose, _COLUMNS)))
        for name in dict.fromkeys(["Ours", *results.methods("rotation")]):
            rotation.append((f"{pose}, {_named(name, results)}", *_measured(results, "rotation", name, pose)))
    updates: list[tuple[str, ...]] = []
    for name, schedule in {"Ours": "once", "w/Linear": "linear", "w/Geometric": "geometric"}.items():
        updates.append((f"{name}, as published", *_published(UPDATES, name, ("minutes", *_COLUMNS))))
        updates.append((_named(name, results), _EMPTY, *_measured(results, "synthetic", name)))
        for method in results.ours:
            if "+" in method and (method.partition("@")[2] or "once") == schedule:
                cells = _measured(results, "synthetic", method)
                updates.append((_named(method, results), _minutes(results, method), *cells))
    losses: list[tuple[str, ...]] = []
    for loss, ending in {_metric("lpips", results): "/paper", "L1 and SSIM": "/paper-l1-dssim"}.items():
        for method in (method for method in results.ours if method.endswith(ending)):
            minutes, cells = _step_minutes(results, method, "consolidate"), _measured(results, "synthetic", method)
            losses.append((f"{loss}: {method}, run here", minutes, *cells))
    head = (*map(title, _COLUMNS), "scenes")
    tables = [
        Table(SYNTHETIC.title, ("method", *head), tuple(synthetic)),
        Table(ROTATION.title, ("pose", *head), tuple(rotation)),
        Table(
            DATA.title, ("model", *(f"{title(m)} {s}" for m, s in map(str.split, DATA.columns))), _data_rows(results)
        ),
        Table(UPDATES.title, ("schedule", title("minutes"), *head), tuple(updates)),
        Table(_LOSS_TITLE, ("loss", title("minutes"), *head), tuple(losses)),
        Table(COST.title, ("part", "minutes, as published", f"minutes here, {results.device}"), _cost_rows(results)),
    ]
    for kind in ("synthetic", "rotation"):
        scenes = [scene.name for scene in results.scenes if scene.kind == kind]
        rows = []
        for name in results.methods(kind):
            values = {item.scene.name: item.values.get("psnr") for item in results.of(kind, name)}
            rows.append((name, *(_text("psnr", values.get(scene)) for scene in scenes)))
        if rows:
            tables.append(Table(f"PSNR by scene: {kind}", ("method", *scenes), tuple(rows)))
    return tables


_LOSS_TITLE = "Perceptual against photometric loss of the consolidation (the paper's Sec. 7.3, which shows pictures)"
_COST_STEPS = {
    "reconstruct, each scene": ("reconstruct source", ""),
    "segment": ("segment", ""),
    "harmonize": ("harmonize", ""),
    "consolidate, LPIPS": ("consolidate", "/paper"),
    "consolidate, L1 and SSIM": ("consolidate", "/paper-l1-dssim"),
}
"""Recorded step and ending of the method's name, by row of the costs."""


def _data_rows(results: PaperResults) -> tuple[tuple[str, ...], ...]:
    rows: list[tuple[str, ...]] = []
    for name in dict.fromkeys([*DATA.rows, *results.by_model]):
        if name in DATA.rows:
            rows.append((f"{name}, as published", *(_text(c.split()[0], DATA.value(name, c)) for c in DATA.columns)))
        if name in results.by_model:
            values = results.by_model[name]
            rows.append((f"{name}, measured here", *(_text(c.split()[0], values.get(c)) for c in DATA.columns)))
    return tuple(rows)


def _cost_rows(results: PaperResults) -> tuple[tuple[str, ...], ...]:
    rows: list[tuple[str, ...]] = []
    for part, (step, ending) in _COST_STEPS.items():
        methods = [method for method in results.ours if "@" not in method and method.endswith(ending)]
        found = [cell for method in methods if (cell := _step_minutes(results, method, step)) != _EMPTY]
        published = _text("minutes", COST.value(part, "minutes"))
        rows.append((part, published, found[0] if found else f"{_EMPTY} (no method that ran has this step)"))
    return tuple(rows)


def _step_minutes(results: PaperResults, method: str, step: str) -> str:
    """Average the time of one step of a method over the synthetic scenes on which it ran."""
    spent = [item.seconds[step] for item in results.of("synthetic", method) if step in item.seconds]
    return _text("minutes", sum(spent) / len(spent) / 60 if spent else None)


def protocol_notes(results: PaperResults) -> list[str]:
    """List the conditions of the measurement, one sentence each."""
    measured = results.measured
    kinds = {kind: sum(scene.kind == kind and not scene.lacks for scene in results.scenes) for kind in SCENES}
    found = ", ".join(f"{count} of {SCENES[kind]} {kind}" for kind, count in kinds.items())
    named = {scene.name for scene in results.scenes}
    absent = [name for names in LISTED.values() for name in names if name not in named]
    others = [scene.name for scene in results.scenes if scene.kind == "real" and scene.name not in LISTED["real"]]
    resolutions = sorted({str(size) for item in measured for size in item.protocol.get("resolution", ())})  # pyright: ignore
    views = sorted({str(item.protocol["views"]) for item in measured})
    notes = [
        f"Scenes of the published data set found: {found}.",
        *([f"Scenes that its card names and that were not found: {', '.join(absent)}."] if absent else []),
        *([f"Real scenes that its card does not name: {', '.join(others)}."] if others else []),
        f"Views: {'; '.join(views) or 'none'} (the paper states this for the rotation experiment alone).",
        f"Resolution: {', '.join(resolutions) or 'none'}, that of the pictures, without resampling or cropping. Values "
        "are read as 8-bit sRGB in [0, 1] and not clamped further; renders of ours are clamped to [0, 1].",
        "Brackets: 95% bootstrap interval of the mean over scenes (10,000 resamples); one scene has none.",
        *(f"{name.upper()}: {text}." for name, text in METRIC_VERSIONS.items()),
        *(f"Not measured: {name}: {reason}" for name, reason in results.not_measured.items()),
        *(f"{scene}, {method}: {reason}" for (scene, method), reason in results.missing.items()),
        *(
            f"{name.upper()}: the weights are not the published ones, so its columns show a stand-in."
            for name in sorted(results.stand_ins)
        ),
        f"Made by splatgraft {version('splatgraft')} at commit {source_commit()}: "
        + shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    ]
    return list(dict.fromkeys(notes))


def _named(method: str, results: PaperResults) -> str:
    return f"{method}, " + ("run here" if method in results.ours else "the authors' pictures, measured here")


def _metric(name: str, results: PaperResults) -> str:
    """Return the title of a metric; it says if the weights are not the published ones."""
    if name == "minutes":
        return name
    return f"stand-in for {name.upper()}" if name in results.stand_ins else name.upper()


def _published(table: PublishedTable, row: str, columns: Sequence[str]) -> list[str]:
    return [*(_text(column, table.value(row, column)) for column in columns), "3" if table is ROTATION else "9"]


def _measured(results: PaperResults, kind: Kind, method: str, pose: str = "") -> list[str]:
    found = results.of(kind, method, pose)
    cells: list[str] = []
    for column in _COLUMNS:
        if column in ("fid", "kid"):
            cells.append(_text(column, results.pooled.get((kind, pose, method), {}).get(column)))
            continue
        summary = summarize([item.values.get(column) for item in found])
        cells.append(_text(column, None if summary is None else summary.mean))
        if summary is not None and summary.scenes > 1:
            cells[-1] += f" [{_text(column, summary.low)}, {_text(column, summary.high)}]"
    return [*cells, str(len(found))]


def _minutes(results: PaperResults, method: str) -> str:
    found = [item.seconds for item in results.of("synthetic", method) if item.seconds]
    spent = [sum(seconds.get(step, 0.0) for step in ("harmonize", "consolidate")) for seconds in found]
    return _text("minutes", sum(spent) / len(spent) / 60 if spent else None)


def _text(metric: str, value: float | None) -> str:
    return _EMPTY if value is None else _FORMATS.get(metric, "{:.4f}").format(value)


def _as_json(results: PaperResults, notes: Sequence[str]) -> dict[str, object]:
    measured = [
        {
            "scene": item.scene.name,
            "kind": item.scene.kind,
            "pose": item.scene.pose,
            "method": item.method,
            "by": "this software" if item.method in results.ours else "the authors",
            "values": dict(item.values),
            "protocol": dict(item.protocol),
            "seconds": dict(item.seconds),
        }
        for item in results.measured
    ]
    return {
        "measured": measured,
        "pooled": [{"kind": k, "pose": p, "method": m, **v} for (k, p, m), v in results.pooled.items()],
        "by_model": {name: dict(values) for name, values in results.by_model.items()},
        "stand_ins": sorted(results.stand_ins),
        "device": results.device,
        "missing": [{"scene": s, "method": m, "reason": r} for (s, m), r in results.missing.items()],
        "not_measured": dict(results.not_measured),
        "metrics": METRIC_VERSIONS,
        "notes": list(notes),
    }


def _figures(out: Path, results: PaperResults) -> list[Path]:
    """Write one sheet of pictures for each kind of scene, like the paper's figures of 3D results."""
    found: list[Path] = []
    for kind, columns in _FIGURES.items():
        wanted = (*columns[:-1], *results.ours, columns[-1])
        scenes = [scene for scene in results.scenes if scene.kind == kind]
        rows = [row for scene in scenes if (row := _figure_row(out, scene, wanted)) is not None]
        if rows:
            width = max(row.shape[1] for row in rows)
            padded = [torch.nn.functional.pad(row, (0, 0, 0, width - row.shape[1], 0, 4), value=1.0) for row in rows]
            (out / "figures").mkdir(parents=True, exist_ok=True)
            found.append(out / "figures" / f"{kind}.png")
            write_image(found[-1], torch.cat(padded))
    return found


def _figure_row(out: Path, scene: PaperScene, columns: Sequence[str]) -> Float[Tensor, "h w 3"] | None:
    """Make a row of a scene's middle held-out view, from the columns that have a picture of it."""
    ours = {name: out / "scenes" / scene.name / "pictures" / name.replace("/", "-") for name in columns}
    folders = {name: path for name, path in ours.items() if path.is_dir()} | dict(scene.results) | dict(scene.folders)
    reference = folders.get("truth") or folders.get("composite")
    if reference is None:
        return None
    stems = list(pictures(reference))
    held = held_out_stems(stems)
    view, labels, shown = held[len(held) // 2], [], []
    for name in columns:
        matched = match_views(stems, pictures(folders[name]))[0] if name in folders else {}
        if view in matched:
            image = read_rgb(matched[view])
            labels.append(f"{scene.name}: {name}" if not labels else name)
            shown.append(resize(image, round(image.shape[1] * _ROW_HEIGHT / image.shape[0]), _ROW_HEIGHT))
    return side_by_side(shown, labels) if shown else None
