"""Writes the evaluation report: a folder with index.html and its pictures that works offline."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from splatgraft.evaluation.pictures import write_animation
from splatgraft.evaluation.report_page import ViewFiles, WarningText, page_html
from splatgraft.runtime.files import atomic_write


@dataclass(frozen=True)
class ReportView:
    """The pictures of one view, all of one size."""

    name: str
    """The view's name."""
    held_out: bool
    """Whether no step before the evaluation used a picture of this view."""
    pictures: Mapping[str, Float[Tensor, "h w 3"]]
    """Label to sRGB image, e.g. "Copy-paste", "Result"; the slider first shows the first two."""


@dataclass(frozen=True)
class StepTime:
    """The duration of one step."""

    name: str
    """The command's name."""
    seconds: float
    """Wall-clock time."""
    note: str = ""
    """A short remark, such as "41k Gaussians, 27.4 dB held out"."""


@dataclass(frozen=True)
class ReportWarning:
    """Something that may be wrong with the result."""

    step: str
    """Name of the step that said it, such as "compose"."""
    text: str
    """What may be wrong."""
    help: str = ""
    """What helps, with the page that explains it."""
    picture: Float[Tensor, "h w 3"] | None = None
    """An sRGB image that shows it."""


@dataclass(frozen=True)
class Report:
    """The texts and metrics of the page."""

    title: str
    """One line."""
    subtitle: str
    """One sentence on object and target."""
    warnings: tuple[ReportWarning, ...] = ()
    """What may be wrong, in the order of the steps; it stands at the top."""
    metrics: dict | None = None
    """The content of metrics.json, see `measure`; None without ground truth."""
    changes: Mapping[str, float] = field(default_factory=dict)
    """`describe_change` averaged over views, shown without ground truth."""
    not_measured: Mapping[str, str] = field(default_factory=dict)
    """Missing metric to the reason, e.g. {"lpips": "no weights at ..."}."""
    light: str = ""
    """Description of the light transfer; each line becomes a paragraph."""
    steps: tuple[StepTime, ...] = ()
    """In the order of execution."""
    machine: str = ""
    """The machine on which the times were measured."""
    limits: tuple[str, ...] = ()
    """Limitations of the result, one sentence each."""


def write_report(
    folder: Path,
    report: Report,
    *,
    views: Iterable[ReportView],
    turntable: Sequence[Float[Tensor, "h w 3"]] = (),
) -> Path:
    """Write index.html and its pictures, and metrics.json where there are metrics.

    Args:
        folder: of the report.
        report: texts and metrics.
        views: consumed one at a time, so that they need not all be in memory.
        turntable: frames of the animation; none where empty.

    Returns:
        The path of index.html.
    """
    (folder / "views").mkdir(parents=True, exist_ok=True)
    files = []
    for number, view in enumerate(views):
        paths = {}
        for place, (label, picture) in enumerate(view.pictures.items()):
            paths[label] = f"views/{number:04d}_{place}.webp"
            _write_webp(folder / paths[label], picture)
        height, width = next(iter(view.pictures.values())).shape[:2]
        files.append(ViewFiles(name=view.name, held_out=view.held_out, files=paths, width=width, height=height))
    if turntable:
        write_animation(folder / "turntable.webp", turntable)
    warned = [_write_warning(folder, number, warning) for number, warning in enumerate(report.warnings)]
    if report.metrics is not None:
        with atomic_write(folder / "metrics.json") as stream:
            stream.write(json.dumps(report.metrics, indent=1, allow_nan=False).encode())
    with atomic_write(folder / "index.html") as stream:
        stream.write(page_html(report, files, warned, turntable="turntable.webp" if turntable else None).encode())
    return folder / "index.html"


def _write_warning(folder: Path, number: int, warning: ReportWarning) -> WarningText:
    file = None
    if warning.picture is not None:
        (folder / "warnings").mkdir(exist_ok=True)
        file = f"warnings/{number:02d}.webp"
        _write_webp(folder / file, warning.picture)
    return WarningText(step=warning.step, text=warning.text, help=warning.help, file=file)


def _write_webp(path: Path, picture: Float[Tensor, "h w 3"]) -> None:
    array = (picture.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    with atomic_write(path) as stream:
        Image.fromarray(array).save(stream, "WEBP", quality=92, method=4)
