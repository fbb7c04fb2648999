"""The evaluation report: a folder with index.html and its pictures that works offline."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from splatgraft.evaluation.pictures import write_animation
from splatgraft.evaluation.report_page import ViewFiles, html_page, viewer
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.note import Note

# key in metrics.json, title, unit, format, whether higher is better, explanation
_METRICS = (
    ("psnr", "Whole image", "PSNR, dB", "{:.2f}", True, "Pixel error over the whole image."),
    ("ssim", "Structure", "SSIM", "{:.4f}", True, "Agreement of local contrast and texture over the whole image."),
    ("flip", "Visible difference", "FLIP", "{:.4f}", False, "What an observer sees when the two images alternate."),
    (
        "lpips",
        "Perception",
        "LPIPS",
        "{:.4f}",
        False,
        "Distance between the features that a trained network computes from both images.",
    ),
    ("object_psnr", "Object", "PSNR, dB", "{:.2f}", True, "Only pixels that the object covers."),
    (
        "shadow_psnr",
        "Shadow band",
        "PSNR, dB",
        "{:.2f}",
        True,
        "Only pixels that the true object darkens by more than 5%.",
    ),
    (
        "shadow_ratio_rmse",
        "Shadow strength",
        "RMSE",
        "{:.4f}",
        False,
        "Error of the ratio of light with the object to light without it, inside the true shadow.",
    ),
    ("rest_psnr", "The rest", "PSNR, dB", "{:.2f}", True, "Only pixels that the true object does not change."),
    (
        "rest_max_change",
        "Change of the rest, worst pixel",
        "0 to 1",
        "{:.4f}",
        False,
        "Difference from the scene without the object where the truth has none; 0 is ideal.",
    ),
    ("rest_mean_change", "Change of the rest, mean", "0 to 1", "{:.5f}", False, "The same, mean over pixels."),
)
_CHANGES = (
    (
        "object_brightness",
        "Brightness of the object",
        "{:.2f} x",
        "Linear light on the object, relative to copy-paste.",
    ),
    (
        "darkened_fraction",
        "Surroundings darkened",
        "{:.1%}",
        "Share of pixels off the object that lost more than 5% of their light.",
    ),
    (
        "brightened_fraction",
        "Surroundings brightened",
        "{:.1%}",
        "Share of pixels off the object that gained more than 5%.",
    ),
)


@dataclass(frozen=True)
class ReportView:
    """The pictures of one view, all of one size."""

    name: str
    """The view's name."""
    held_out: bool
    """Whether no step before the evaluation used a picture of this view."""
    pictures: Mapping[str, Float[Tensor, "h w 3"]]
    """sRGB images by label, such as "Copy-paste" and "Result"; the slider begins with the first two."""


@dataclass(frozen=True)
class StepTime:
    """The duration of one step."""

    name: str
    """The command's name."""
    seconds: float
    """Wall-clock time."""
    note: str = ""
    """Short remark, such as "41k Gaussians, 27.4 dB held out"."""


@dataclass(frozen=True)
class ReportWarning:
    """A warning that a step gave about the result."""

    step: str
    """Name of the step, such as "compose"."""
    note: Note
    """Text of the warning, and a remedy."""
    picture: Float[Tensor, "h w 3"] | None = None
    """sRGB image that shows the problem."""


@dataclass(frozen=True)
class Report:
    """The texts and metrics of the page."""

    title: str
    """Title of the page, one line."""
    subtitle: str
    """One sentence on object and target."""
    warnings: tuple[ReportWarning, ...] = ()
    """Warnings of the steps, in their order, for the top of the page."""
    metrics: dict | None = None
    """Content of metrics.json, see `measure`; None without ground truth."""
    changes: Mapping[str, float] = field(default_factory=dict)
    """`describe_change` averaged over views, shown without ground truth."""
    not_measured: Mapping[str, str] = field(default_factory=dict)
    """Reason for each missing metric, such as {"lpips": "no weights at ..."}."""
    light: str = ""
    """Description of the light transfer; each line becomes a paragraph."""
    steps: tuple[StepTime, ...] = ()
    """Duration of the steps, in the order of execution."""
    machine: str = ""
    """The machine on which the times were measured."""
    limits: tuple[str, ...] = ()
    """Limitations of the result, one sentence each."""


def write_report(
    folder: Path,
    report: Report,
    *,
    views: Iterable[ReportView],
    geometry: Iterable[ReportView] = (),
    turntable: Sequence[Float[Tensor, "h w 3"]] = (),
) -> Path:
    """Write index.html with its pictures, one view at a time, and metrics.json if there are metrics.

    Args:
        folder: Folder of the report; it is created.
        report: Texts and metrics.
        views: The views that the page compares; it begins with the first.
        geometry: Result, depth and normals of some views, shown side by side.
        turntable: Frames around the object.

    Returns:
        The path of index.html.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [_write_view(folder, f"views/{number:04d}", view) for number, view in enumerate(views)]
    geometry_files = [_write_view(folder, f"geometry/{number:04d}", view) for number, view in enumerate(geometry)]
    if turntable:
        write_animation(folder / "turntable.webp", turntable)
    for number, warning in enumerate(report.warnings):
        if warning.picture is not None:
            (folder / "warnings").mkdir(exist_ok=True)
            _write_webp(folder / _warning_file(number), warning.picture)
    if report.metrics is not None:
        with atomic_write(folder / "metrics.json") as stream:
            stream.write(json.dumps(report.metrics, indent=1, allow_nan=False).encode())
    with atomic_write(folder / "index.html") as stream:
        animation = "turntable.webp" if turntable else None
        stream.write(_page(report, files, geometry=geometry_files, turntable=animation).encode())
    return folder / "index.html"


def _write_view(folder: Path, stem: str, view: ReportView) -> ViewFiles:
    """Write the pictures of one view to files whose names begin with `stem`."""
    (folder / stem).parent.mkdir(parents=True, exist_ok=True)
    paths: dict[str, str] = {}
    for place, (label, picture) in enumerate(view.pictures.items()):
        paths[label] = f"{stem}_{place}.webp"
        _write_webp(folder / paths[label], picture)
    height, width = next(iter(view.pictures.values())).shape[:2]
    return ViewFiles(name=view.name, held_out=view.held_out, files=paths, width=width, height=height)


def _write_webp(path: Path, picture: Float[Tensor, "h w 3"]) -> None:
    array = (picture.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    with atomic_write(path) as stream:
        Image.fromarray(array).save(stream, "WEBP", quality=92, method=4)


def _page(report: Report, views: Sequence[ViewFiles], *, geometry: Sequence[ViewFiles], turntable: str | None) -> str:
    """Format the page; `turntable` is the animation's file relative to the page."""
    sections = [
        _warnings(report.warnings),
        viewer(views) if views else "",
        _turntable(turntable) if turntable else "",
        _geometry(geometry) if geometry else "",
        _numbers(report),
        _prose("Light", "light", report.light.splitlines()),
        _steps(report.steps, report.machine),
        _list("Limitations", report.limits),
    ]
    return html_page(report.title, report.subtitle, "".join(sections), views=views)


def _warning_file(number: int) -> str:
    return f"warnings/{number:02d}.webp"


def _warnings(warnings: Sequence[ReportWarning]) -> str:
    if not warnings:
        return ""
    items = "".join(
        f"<li><p><b>{escape(one.step)}</b> {escape(one.note.text)}</p>"
        + (f'<p class="quiet">{escape(one.note.remedy)}</p>' if one.note.remedy else "")
        + (
            f'<img loading="lazy" src="{_warning_file(number)}" alt="What the warning is about">'
            if one.picture is not None
            else ""
        )
        + "</li>"
        for number, one in enumerate(warnings)
    )
    return f'<section class="warnings"><h2>What may be wrong</h2><ul>{items}</ul></section>\n'


def _turntable(file: str) -> str:
    return f"""<section><h2>Around the object</h2>
<figure><img class="turntable" src="{escape(file)}" alt="The result seen from a path between the captured cameras">
<figcaption>The result from viewpoints between the captured ones; none of them was used by any step.</figcaption>
</figure></section>
"""


def _geometry(views: Sequence[ViewFiles]) -> str:
    pictures = "".join(
        f'<figure><img loading="lazy" src="{escape(file)}" alt="{escape(label)} of view {escape(view.name)}">'
        f"<figcaption>{escape(label)}</figcaption></figure>"
        for view in views
        for label, file in view.files.items()
    )
    return f"""<section><h2>Depth and normals</h2>
<p>The surface of the result. Depth goes from yellow (near) to violet (far). Normals are green where a surface faces up
in the picture, red where it faces right, blue where it faces you; edges are black. A table should be one even ramp:
islands of another colour are surfaces that the photographs did not fix.</p>
<div class="geometry">{pictures}</div></section>
"""


def _numbers(report: Report) -> str:
    if report.metrics is None:
        rows = "".join(
            f'<tr><th scope="row">{title}<small>{words}</small></th><td>{form.format(report.changes[name])}</td></tr>'
            for name, title, form, words in _CHANGES
            if name in report.changes
        )
        table = f'<div class="scroll"><table><tbody>{rows}</tbody></table></div>' if rows else ""
        return f"""<section><h2>Numbers</h2>
<p>These captures come without ground truth, so the light's correctness cannot be measured. The numbers describe what
the transfer changed.</p>{table}</section>
"""
    metrics = report.metrics
    rows = "".join(_metric_row(metrics, row, report.not_measured) for row in _METRICS)
    held_out = metrics["views"] == "held out"
    which = "that no step has used" if held_out else "(none is held out; earlier steps have used them)"
    return f"""<section><h2>Numbers</h2>
<p>Against ground truth, mean over {metrics["view_count"]} views {which}. Copy-paste is the object as it was captured,
put in place without light transfer.</p>
<div class="scroll"><table><thead><tr><th scope="col">What</th><th scope="col">Copy-paste</th>
<th scope="col">Result</th><th scope="col">Change</th></tr></thead><tbody>{rows}</tbody></table></div>
<p class="quiet">PSNR and SSIM: higher is better. LPIPS, RMSE and change: lower is better. The numbers of every view are
in <a href="metrics.json">metrics.json</a>.</p></section>
"""


def _metric_row(metrics: dict, row: tuple[str, str, str, str, bool, str], reasons: Mapping[str, str]) -> str:
    name, title, unit, form, more_is_better, words = row
    head = f'<tr><th scope="row">{title} <em>{unit}</em><small>{words}</small></th>'
    before, after = metrics["copy_paste"].get(name), metrics["result"].get(name)
    if before is None and after is None:
        computed = name in metrics["result"]
        reason = reasons.get(name, "no view has such a region" if computed else "it was not requested")
        return f'{head}<td colspan="3" class="missing">not measured: {escape(reason)}</td></tr>'
    cells = "".join(f"<td>{'-' if value is None else form.format(value)}</td>" for value in (before, after))
    if before is None or after is None:
        return f"{head}{cells}<td></td></tr>"
    change = form.replace("{:", "{:+").format(after - before)
    unchanged = float(change) == 0
    kind = "same" if unchanged else "better" if (after > before) == more_is_better else "worse"
    word = "no change" if unchanged else f"{change} {kind}"
    return f'{head}{cells}<td><span class="chip {kind}">{word}</span></td></tr>'


def _prose(title: str, name: str, lines: Sequence[str]) -> str:
    paragraphs = "".join(f"<p>{escape(line)}</p>" for line in lines if line.strip())
    return f'<section class="{name}"><h2>{title}</h2>{paragraphs}</section>\n' if paragraphs else ""


def _steps(steps: Sequence[StepTime], machine: str) -> str:
    if not steps:
        return ""
    longest = max([1e-9, *(step.seconds for step in steps)])
    rows = "".join(
        f'<tr><th scope="row">{escape(step.name)}<small>{escape(step.note)}</small></th>'
        f'<td class="bar"><span style="width:{100 * step.seconds / longest:.1f}%"></span></td>'
        f"<td>{_duration(step.seconds)}</td></tr>"
        for step in steps
    )
    total = _duration(sum(step.seconds for step in steps))
    where = f" on {escape(machine)}" if machine else ""
    return f"""<section><h2>Time</h2><p>{total} in total{where}.</p>
<div class="scroll"><table class="steps"><tbody>{rows}</tbody></table></div></section>
"""


def _list(title: str, sentences: Sequence[str]) -> str:
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    return f"<section><h2>{title}</h2><ul>{items}</ul></section>\n" if items else ""


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"
