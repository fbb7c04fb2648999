"""The report as a folder: index.html and the pictures beside it, nothing from elsewhere. Takes no measurement."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from splatgraft.evaluation.pictures import write_animation
from splatgraft.evaluation.report_page import ViewFiles, page_html
from splatgraft.runtime.atomic_file import atomic_write


@dataclass(frozen=True)
class ReportView:
    """One view's pictures, of one size."""

    name: str
    """The view's name."""
    held_out: bool
    """Whether no step before has seen a picture of this view."""
    pictures: Mapping[str, Float[Tensor, "h w 3"]]
    """Label to sRGB picture, e.g. "Copy-paste", "Result"; the first two are what the slider shows first."""


@dataclass(frozen=True)
class StepTime:
    """What one step took."""

    name: str
    """The command's name."""
    seconds: float
    """Wall-clock time."""
    note: str = ""
    """A few words, such as "41k Gaussians, 27.4 dB held out"."""


@dataclass(frozen=True)
class Report:
    """All that the page says in words and numbers."""

    title: str
    """One line."""
    subtitle: str
    """One sentence on what went where."""
    metrics: dict | None = None
    """The content of metrics.json as `measure` makes it; None where there is no ground truth."""
    changes: Mapping[str, float] = field(default_factory=dict)
    """`describe_change` averaged over views, shown where there is no ground truth."""
    not_measured: Mapping[str, str] = field(default_factory=dict)
    """Metric name to the reason why it is missing, e.g. {"lpips": "no weights at ..."}."""
    light: str = ""
    """What the light transfer says about itself; lines become paragraphs."""
    steps: tuple[StepTime, ...] = ()
    """In the order in which they ran."""
    machine: str = ""
    """What the times were taken on."""
    limits: tuple[str, ...] = ()
    """What a reader must know before trusting the result, one sentence each."""


def write_report(
    folder: Path,
    report: Report,
    *,
    views: Iterable[ReportView],
    turntable: Sequence[Float[Tensor, "h w 3"]] = (),
) -> Path:
    """Write `folder`/index.html and its pictures; gives the page's path. Views are taken one at a time.

    Where `report.metrics` is there, metrics.json is written beside the page.
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
    if report.metrics is not None:
        with atomic_write(folder / "metrics.json") as stream:
            stream.write(json.dumps(report.metrics, indent=1, allow_nan=False).encode())
    with atomic_write(folder / "index.html") as stream:
        stream.write(page_html(report, files, turntable="turntable.webp" if turntable else None).encode())
    return folder / "index.html"


def _write_webp(path: Path, picture: Float[Tensor, "h w 3"]) -> None:
    array = (picture.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    with atomic_write(path) as stream:
        Image.fromarray(array).save(stream, "WEBP", quality=92, method=4)
