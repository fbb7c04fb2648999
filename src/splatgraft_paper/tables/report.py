"""The paper's tables and figures with published and measured numbers, as Markdown, JSON and a page."""

import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
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
from splatgraft_paper.benchmark.methods import Method
from splatgraft_paper.benchmark.table import Table, summarize, table_section
from splatgraft_paper.tables.layout import Kind, PaperScene, held_out_stems, match_views, pictures
from splatgraft_paper.tables.measure_pictures import LPIPS
from splatgraft_paper.tables.our_pictures import SHOWN_UPDATES, updates_folder
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
from splatgraft_paper.tables.run import METRIC_VERSIONS, Measured, PaperResults

_FORMATS = {"psnr": "{:.2f}", "fid": "{:.2f}", "minutes": "{:.2f}", "ssim": "{:.3f}"}
_FORMATS |= dict.fromkeys(LPIPS, "{:.3f}")
_LESS_IS_BETTER = (*LPIPS, "fid", "kid", "flip", "minutes")
_COLUMNS = ("psnr", "ssim", *LPIPS, "fid", "kid", "flip")
_EMPTY = "–"  # cell without a number; the notes give the reason
_FIGURES: dict[Kind, tuple[str, ...]] = {
    "synthetic": ("composite", "GS-IR", "GShader", "3DGS-DR", "Ours", "truth"),
    "real": ("background", "composite", "GS-IR", "GShader", "3DGS-DR", "Ours"),
    "rotation": ("composite", "Ours", "truth"),
}
"""Columns of the paper's figures of 3D results; our methods are inserted before the last."""
_BESIDE: dict[Kind, str] = {"synthetic": SYNTHETIC.title, "real": SYNTHETIC.title, "rotation": ROTATION.title}
"""Title of the table beside the figures of a kind."""
_ROW_HEIGHT = 200  # height of a picture in a figure, pixels


def write_paper_report(out: Path, results: PaperResults) -> Path:
    """Write index.html, paper.md, paper.json and figures/, and return the page."""
    tables, notes, figures = paper_tables(results), protocol_notes(results), _figures(out, results)
    text, body = [], ""
    for table in tables:
        text.append(table.markdown())
        body += table_section(table)
        for path, caption in figures.pop(table.title, []):
            place = path.relative_to(out).as_posix()
            text.append(f"![{caption}]({place})")
            image = f'<img src="{place}" alt="{path.stem}" style="max-width:100%">'
            body += f"<section><h2>Figure: {escape(caption)}</h2>{image}</section>"
    text.append("\n".join(f"- {note}" for note in notes))
    out.mkdir(parents=True, exist_ok=True)
    (out / "paper.md").write_text("\n\n".join(text) + "\n", encoding="utf-8")
    (out / "paper.json").write_text(json.dumps(_as_json(results, notes), indent=1, allow_nan=False), encoding="utf-8")
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
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
            parsed = Method.parse(method)
            if parsed.harmonizer and parsed.schedule == schedule and parsed.loss != "paper-l1-dssim":
                cells = _measured(results, "synthetic", method)
                updates.append((_named(method, results), _minutes(results, method), *cells))
    losses: list[tuple[str, ...]] = []
    for loss, kind in {_metric("lpips", results): "paper", "L1 and SSIM": "paper-l1-dssim"}.items():
        for method in _once_with(results, kind):
            minutes, cells = _step_minutes(results, method, "consolidate"), _measured(results, "synthetic", method)
            losses.append((f"{loss}: {method}, run here", minutes, *cells))
    head = (*map(title, _COLUMNS), "scenes")
    tables = [
        Table(SYNTHETIC.title, ("method", *head), tuple(synthetic)),
        Table(ROTATION.title, ("pose", *head), tuple(rotation)),
        *_agreement(results),
        Table(
            DATA.title, ("model", *(f"{title(m)} {s}" for m, s in map(str.split, DATA.columns))), _data_rows(results)
        ),
        Table(UPDATES.title, ("schedule", title("minutes"), *head), tuple(updates)),
        Table(_LOSS_TITLE, ("loss", title("minutes"), *head), tuple(losses)),
        Table(COST.title, ("part", "minutes, as published", *_PIPELINES.values()), _cost_rows(results)),
    ]
    for kind in ("synthetic", "rotation"):
        scenes = [scene.name for scene in results.scenes if scene.kind == kind]
        rows = []
        for name in results.methods(kind):
            values = {item.scene.name: item.values.get("psnr") for item in results.of(kind, name)}
            rows.append((name, *(_text("psnr", values.get(scene)) for scene in scenes)))
        if rows:
            tables.append(Table(f"PSNR by scene: {kind}", ("method", *scenes), tuple(rows)))
    return [replace(table, note=results.conditions) for table in tables]


def _agreement(results: PaperResults) -> list[Table]:
    """Make the table of disagreements of neighbouring views beside Table 2; empty if none was measured."""
    rows = []
    for pose in ROTATION.rows:
        for method in results.ours:
            found = [item.values for item in results.of("rotation", method, pose) if "disagreement" in item.values]
            if found:
                means = [sum(one[key] for one in found) / len(found) for key in ("disagreement", "disagreement_truth")]
                rows.append((pose, method, *(f"{mean:.4f}" for mean in means), str(len(found))))
    head = ("pose", "method", "disagreement ↓", "of the truth itself", "scenes")
    return [Table(_AGREEMENT_TITLE, head, tuple(rows))] if rows else []


_AGREEMENT_TITLE = "Neighbouring views warped onto each other by the composite's depth, RMSE in sRGB (beside Table 2)"
_LOSS_TITLE = "Perceptual against photometric loss of the consolidation (the paper's Sec. 7.3, which shows pictures)"
_PIPELINES = {"paper": "minutes here, the paper's pipeline", "ours": "minutes here, ours"}
"""Columns of the costs; our segmentation also refits the object, so the two are not the same work."""
_COST_STEPS = {
    "reconstruct, each scene": ("reconstruct source", ""),
    "segment": ("segment", ""),
    "harmonize": ("harmonize", ""),
    "consolidate, LPIPS": ("consolidate", "paper"),
    "consolidate, L1 and SSIM": ("consolidate", "paper-l1-dssim"),
}
"""Recorded step and the method's loss, by row of the costs."""


def _once_with(results: PaperResults, loss: str, pipeline: str = "") -> list[str]:
    """List our methods without updates that have a loss and a pipeline; an empty text allows any."""
    parsed = [Method.parse(name) for name in results.ours]
    chosen = [one for one in parsed if one.schedule == "once" and loss in ("", one.loss if one.harmonizer else "none")]
    return [one.name for one in chosen if pipeline in ("", one.pipeline)]


def _data_rows(results: PaperResults) -> tuple[tuple[str, ...], ...]:
    rows: list[tuple[str, ...]] = []
    for name in dict.fromkeys([*DATA.rows, *results.by_model.values]):
        if name in DATA.rows:
            rows.append((f"{name}, as published", *(_text(c.split()[0], DATA.value(name, c)) for c in DATA.columns)))
        if name in results.by_model.values:
            values = results.by_model.values[name]
            rows.append((f"{name}, measured here", *(_text(c.split()[0], values.get(c)) for c in DATA.columns)))
    return tuple(rows)


def _cost_rows(results: PaperResults) -> tuple[tuple[str, ...], ...]:
    rows: list[tuple[str, ...]] = []
    for part, (step, loss) in _COST_STEPS.items():
        cells = []
        for pipeline in _PIPELINES:
            spent = [_step_minutes(results, method, step) for method in _once_with(results, loss, pipeline)]
            found = [cell for cell in spent if cell != _EMPTY]
            cells.append(found[0] if found else f"{_EMPTY} (no method that ran has this step)")
        rows.append((part, _text("minutes", COST.value(part, "minutes")), *cells))
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
        *(f"{_metric(name, results)}: {text}." for name, text in METRIC_VERSIONS.items()),
        *(f"Not measured: {name}: {reason}" for name, reason in results.not_measured.items()),
        *(f"{scene}, {method}: {reason}" for (scene, method), reason in results.missing.items()),
        *results.by_model.notes,
        *(
            f"{_metric(name, results).removeprefix('stand-in for ')}: the weights are not the published ones, so its "
            "columns show a stand-in."
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
    title = f"LPIPS [{LPIPS[name]:.0f}, 1]" if name in LPIPS else name.upper()
    return f"stand-in for {title}" if name in results.stand_ins else title


def _published(table: PublishedTable, row: str, columns: Sequence[str]) -> list[str]:
    # the paper's LPIPS may be either of the two
    numbers = [table.value(row, "lpips" if column in LPIPS else column) for column in columns]
    return [*map(_text, columns, numbers), "3" if table is ROTATION else "9"]


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
        "by_model": {name: dict(values) for name, values in results.by_model.values.items()},
        "stand_ins": sorted(results.stand_ins),
        "device": results.device,
        "missing": [{"scene": s, "method": m, "reason": r} for (s, m), r in results.missing.items()],
        "not_measured": dict(results.not_measured),
        "metrics": METRIC_VERSIONS,
        "notes": list(notes),
    }


def _figures(out: Path, results: PaperResults) -> dict[str, list[tuple[Path, str]]]:
    """Write sheets like the paper's figures of 3D results, and the worst scene, by the title of the table beside."""
    found: dict[str, list[tuple[Path, str]]] = {UPDATES.title: _update_figure(out, results)}
    for kind, columns in _FIGURES.items():
        wanted = (*columns[:-1], *results.ours, columns[-1])
        scenes = [scene for scene in results.scenes if scene.kind == kind]
        sheets = {kind: (scenes, f"{kind} scenes; below each picture the part that the object changes most")}
        if (worst := _worst_scene(results, kind)) is not None:
            method, item = worst
            caption = f"worst of {kind}: {item.scene.name}, {item.values['psnr']:.2f} dB by {method}"
            sheets[f"{kind}_worst"] = ([item.scene], caption)
        for name, (shown, caption) in sheets.items():
            rows = [row for scene in shown if (row := _figure_row(out, scene, wanted, results.ours)) is not None]
            if rows:
                path = out / "figures" / f"{name}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_image(path, stacked(rows))
                found.setdefault(_BESIDE[kind], []).append((path, caption))
    return found


def _update_figure(out: Path, results: PaperResults) -> list[tuple[Path, str]]:
    """Write one scene after 1, 3 and 5 updates, a row per schedule, like the paper's figure."""
    methods = [one for name in results.ours if (one := Method.parse(name)).schedule != "once"]
    for scene in results.scenes:
        rows = []
        for method in methods:
            folders = [updates_folder(out / "scenes" / scene.name, method, number) for number in SHOWN_UPDATES]
            if all(folder.is_dir() for folder in folders):
                images = [read_rgb(next(iter(pictures(folder).values()))) for folder in folders]
                rows.append(side_by_side(images, [f"{method.name}, update {number}" for number in SHOWN_UPDATES]))
        if rows:
            path = out / "figures" / "updates.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, stacked(rows))
            return [(path, f"{scene.name} after 1, 3 and 5 updates")]
    return []


def _worst_scene(results: PaperResults, kind: Kind) -> tuple[str, Measured] | None:
    """Find the scene with the lowest PSNR of the paper's method, or else of the first that was measured."""
    measured = {method: results.of(kind, method) for method in ("paper", "Ours", *results.methods(kind))}
    chosen = next(((method, items) for method, items in measured.items() if items), None)
    return None if chosen is None else (chosen[0], min(chosen[1], key=lambda item: item.values["psnr"]))


def stacked(rows: Sequence[Float[Tensor, "_ _ 3"]]) -> Float[Tensor, "h w 3"]:
    """Join rows of pictures below each other, with thin white gaps."""
    width = max(row.shape[1] for row in rows)
    pads = ((0, 0, 0, width - row.shape[1], 0, 4) for row in rows)
    return torch.cat([torch.nn.functional.pad(row, pad, value=1.0) for row, pad in zip(rows, pads, strict=True)])


def _figure_row(
    out: Path, scene: PaperScene, columns: Sequence[str], named: Mapping[str, str]
) -> Float[Tensor, "h w 3"] | None:
    """Make a row of a scene's middle held-out view, from the columns that have a picture of it, with insets below."""
    ours = {name: out / "scenes" / scene.name / "pictures" / folder for name, folder in named.items()}
    folders = {name: path for name, path in ours.items() if path.is_dir()} | dict(scene.results) | dict(scene.folders)
    reference = folders.get("truth") or folders.get("composite")
    if reference is None:
        return None
    stems = list(pictures(reference))
    held = held_out_stems(stems)
    view, images = held[len(held) // 2], {}
    for name in dict.fromkeys((*columns, "background", "composite", "truth")):
        matched = match_views(stems, pictures(folders[name]))[0] if name in folders else {}
        if view in matched:
            images[name] = read_rgb(matched[view])
    part = _changed_part(images)
    labels, shown = [], []
    for name in (name for name in columns if name in images):
        image = images[name]
        width = round(image.shape[1] * _ROW_HEIGHT / image.shape[0])
        labels.append(f"{scene.name}: {name}" if not labels else name)
        shown.append(torch.cat([resize(one, width, _ROW_HEIGHT) for one in (image, image[part])]))
    return side_by_side(shown, labels) if shown else None


def _changed_part(images: Mapping[str, Float[Tensor, "h w 3"]]) -> tuple[slice, slice]:
    """Find the third of a view, along each side, with the largest change from the composite to truth or background."""
    first = next(iter(images.values()))
    pair = [images[name] for name in ("composite", "truth", "background") if name in images][:2]
    size = (first.shape[0] // 3, first.shape[1] // 3)
    if len(pair) < 2 or pair[0].shape != pair[1].shape:
        return slice(size[0], 2 * size[0]), slice(size[1], 2 * size[1])
    change = (pair[0] - pair[1]).abs().sum(-1)[None, None]
    sums = torch.nn.functional.avg_pool2d(change, size, 1)[0, 0]
    top, left = divmod(int(sums.argmax()), sums.shape[1])
    return slice(top, top + size[0]), slice(left, left + size[1])
