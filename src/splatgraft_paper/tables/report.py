"""Files of a run on the authors' data set: tables as Markdown, JSON and a page, and the paper's figures of pictures."""

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
from splatgraft_paper.benchmark.table import table_section
from splatgraft_paper.tables.layout import Kind, PaperScene, held_out_stems, match_views, pictures
from splatgraft_paper.tables.paper_numbers import SCENES
from splatgraft_paper.tables.run import METRIC_VERSIONS, PaperResults
from splatgraft_paper.tables.tables import ExplainedTable, paper_tables

_ROW_HEIGHT = 200
"""Pixels of a picture in a figure."""
_FIGURES: dict[Kind, tuple[str, ...]] = {
    "synthetic": ("composite", "GS-IR", "GShader", "3DGS-DR", "Ours", "truth"),
    "real": ("background", "composite", "GS-IR", "GShader", "3DGS-DR", "Ours"),
    "rotation": ("composite", "Ours", "truth"),
}
"""Columns of the paper's figures of 3D results; our methods come before the last."""


def write_paper_report(out: Path, results: PaperResults) -> Path:
    """Write index.html, paper.md, paper.json and figures/; returns the page."""
    tables, notes = paper_tables(results), protocol_notes(results)
    figures = _figures(out, results)
    shown = [f"![{path.stem}]({path.relative_to(out).as_posix()})" for path in figures]
    text = [*(table.markdown() for table in tables), *shown, "\n".join(f"- {note}" for note in notes)]
    (out / "paper.md").write_text("\n\n".join(text) + "\n")
    (out / "paper.json").write_text(json.dumps(_as_json(results, notes), indent=1, allow_nan=False))
    images = "".join(
        f'<section><h2>Figure: {path.stem}</h2><img src="{path.relative_to(out).as_posix()}" alt="{path.stem}" '
        f'style="max-width:100%"></section>'
        for path in figures
    )
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    protocol = f"<section><h2>Protocol</h2><ul>{items}</ul></section>"
    body = "".join(_section(table) for table in tables) + images + protocol
    subtitle = "Published numbers beside those measured here; numbers in brackets name the reason of an empty cell."
    page = out / "index.html"
    page.write_text(html_page("The paper's tables", subtitle, body, views=()))
    return page


def protocol_notes(results: PaperResults) -> list[str]:
    """What a reader needs to know to compare the numbers, one sentence each."""
    measured = results.measured
    kinds = {kind: sum(scene.kind == kind for scene in results.scenes) for kind in SCENES}
    found = ", ".join(f"{count} of {SCENES[kind]} {kind}" for kind, count in kinds.items())
    resolutions = sorted({str(size) for item in measured for size in item.protocol.get("resolution", ())})  # pyright: ignore
    views = sorted({str(item.protocol["views"]) for item in measured})
    masked = sum(bool(item.protocol.get("masks")) for item in measured)
    notes = [
        f"Scenes of the published data set found: {found}.",
        f"Views: {'; '.join(views) or 'none'} (the paper says so of the rotation experiment, not of the others).",
        f"Resolution: {', '.join(resolutions) or 'none'}, as the pictures are; nothing is resampled or cropped. Values "
        "are read as 8-bit sRGB in [0, 1] and not clamped further; renders of ours are clamped to [0, 1].",
        f"Masks: {masked} of {len(measured)} measurements have masks; metrics of regions need them.",
        "Brackets: 95% bootstrap interval of the mean over scenes (10,000 resamples); one scene has none.",
        *(f"{name.upper()}: {text}." for name, text in METRIC_VERSIONS.items()),
        *(f"Not measured: {name}: {reason}" for name, reason in results.not_measured.items()),
        *(f"{scene}, {method}: {reason}" for (scene, method), reason in results.missing.items()),
        f"Made by splatgraft {version('splatgraft')}: {shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])}",
    ]
    return list(dict.fromkeys(notes))


def _as_json(results: PaperResults, notes: Sequence[str]) -> dict[str, object]:
    return {
        "measured": [
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
        ],
        "pooled": [{"kind": k, "pose": p, "method": m, **v} for (k, p, m), v in results.pooled.items()],
        "missing": [{"scene": s, "method": m, "reason": r} for (s, m), r in results.missing.items()],
        "not_measured": dict(results.not_measured),
        "metrics": METRIC_VERSIONS,
        "notes": list(notes),
    }


def _section(explained: ExplainedTable) -> str:
    items = "".join(f"<li>{escape(reason)}</li>" for reason in explained.reasons)
    return table_section(explained.table) + (f"<ol>{items}</ol>" if items else "")


def _figures(out: Path, results: PaperResults) -> list[Path]:
    """One sheet of pictures for each kind of scene, as the paper's figures of 3D results."""
    found: list[Path] = []
    for kind, columns in _FIGURES.items():
        ours = [name for name in results.ours if any(results.of(kind, name))]
        wanted = (*columns[:-1], *ours, columns[-1])
        scenes = [scene for scene in results.scenes if scene.kind == kind]
        rows = [row for scene in scenes if (row := _figure_row(out, scene, wanted, results)) is not None]
        if rows:
            width = max(row.shape[1] for row in rows)
            padded = [torch.nn.functional.pad(row, (0, 0, 0, width - row.shape[1], 0, 4), value=1.0) for row in rows]
            (out / "figures").mkdir(parents=True, exist_ok=True)
            found.append(out / "figures" / f"{kind}.png")
            write_image(found[-1], torch.cat(padded))
    return found


def _figure_row(
    out: Path, scene: PaperScene, columns: Sequence[str], results: PaperResults
) -> Float[Tensor, "h w 3"] | None:
    """The middle held-out view of a scene by each column that has a picture of it."""
    folders = {name: scene.folders.get(name) or scene.results.get(name) for name in columns}
    for name in results.ours:
        folder = out / "scenes" / scene.name / "pictures" / name.replace("/", "-")
        folders[name] = folder if folder.is_dir() else None
    if folders.get("composite") is None:
        folders["composite"] = scene.results.get("Composite")
    reference = scene.folders.get("truth") or scene.folders.get("composite")
    reference = reference or next((folder for folder in folders.values() if folder is not None), None)
    if reference is None:
        return None
    stems = list(pictures(reference))
    held = held_out_stems(stems)
    view = held[len(held) // 2]
    labels, shown = [], []
    for name in columns:
        folder = folders.get(name)
        matched = match_views(stems, pictures(folder))[0] if folder is not None else {}
        if view in matched:
            image = read_rgb(matched[view])
            labels.append(f"{scene.name}: {name}" if not labels else name)
            shown.append(resize(image, round(image.shape[1] * _ROW_HEIGHT / image.shape[0]), _ROW_HEIGHT))
    return side_by_side(shown, labels) if shown else None
