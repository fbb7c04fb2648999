"""The HTML of the evaluation report; style and scripts are in page.css and page.js."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatgraft.evaluation.report import Report, StepTime

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
    (
        "object_psnr",
        "Object",
        "PSNR, dB",
        "{:.2f}",
        True,
        "Only pixels that the object covers.",
    ),
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
class ViewFiles:
    """The picture files of one view, relative to the page."""

    name: str
    """The view's name."""
    held_out: bool
    """Whether no step before the evaluation used a picture of this view."""
    files: Mapping[str, str]
    """Label to file."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""


@dataclass(frozen=True)
class WarningText:
    """One warning as the page shows it."""

    step: str
    """Name of the step."""
    text: str
    """What may be wrong."""
    help: str
    """What helps; empty where nothing is known to."""
    file: str | None
    """A picture, relative to the page."""


def page_html(
    report: "Report", views: Sequence[ViewFiles], warnings: Sequence[WarningText] = (), *, turntable: str | None
) -> str:
    """Format the page; `turntable` is the animation's file relative to the page."""
    sections = [
        _warnings(warnings),
        viewer(views) if views else "",
        _turntable(turntable) if turntable else "",
        _numbers(report),
        _prose("Light", "light", report.light.splitlines()),
        _steps(report.steps, report.machine),
        _list("Limitations", report.limits),
    ]
    return html_page(report.title, report.subtitle, "".join(sections), views=views)


def html_page(title: str, subtitle: str, sections: str, *, views: Sequence[ViewFiles]) -> str:
    """Format a page with style and scripts around HTML `sections`; `views` are those that its `viewer` shows."""
    here = files("splatgraft.evaluation")
    data = json.dumps([{**asdict(view), "files": dict(view.files)} for view in views]).replace("<", "\\u003c")
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{(here / "page.css").read_text(encoding="utf-8")}</style>
</head>
<body>
<header>
<h1>{escape(title)}</h1>
<p>{escape(subtitle)}</p>
</header>
<main>
{sections}</main>
<footer>Made by splatgraft. The page needs only the files in its folder; it loads nothing from the network.</footer>
<script type="application/json" id="views">{data}</script>
<script>
{(here / "page.js").read_text(encoding="utf-8")}</script>
</body>
</html>
"""


def viewer(views: Sequence[ViewFiles]) -> str:
    """Format two pictures of one view with a slider between them, and thumbnails of all views."""
    first = views[0]
    labels = list(first.files)
    left, right = labels[0], labels[min(1, len(labels) - 1)]
    thumbnails = "".join(
        f'<button type="button" class="thumb" data-view="{i}" title="{escape(view.name)}"'
        f' aria-label="view {escape(view.name)}{", held out" if view.held_out else ""}">'
        f'<img loading="lazy" src="{escape(list(view.files.values())[min(1, len(view.files) - 1)])}" alt="">'
        f"{'<i>held out</i>' if view.held_out else ''}</button>"
        for i, view in enumerate(views)
    )
    return f"""<section id="viewer" aria-label="Compare">
<div class="compare" style="aspect-ratio:{first.width}/{first.height}">
<img id="right" src="{escape(first.files[right])}" alt="{escape(right)}">
<img id="left" src="{escape(first.files[left])}" alt="{escape(left)}">
<span class="divider"></span><span class="tag start"></span><span class="tag end"></span>
<input id="split" type="range" min="0" max="100" step="0.1" value="50" aria-label="Divide between the two pictures">
</div>
<div class="choices"><fieldset id="choose-left"><legend>Left</legend></fieldset>
<p id="caption"></p>
<fieldset id="choose-right"><legend>Right</legend></fieldset></div>
<div class="thumbs">{thumbnails}</div>
</section>
"""


def _warnings(warnings: Sequence[WarningText]) -> str:
    if not warnings:
        return ""
    items = "".join(
        f"<li><p><b>{escape(one.step)}</b> {escape(one.text)}</p>"
        + (f'<p class="quiet">{escape(one.help)}</p>' if one.help else "")
        + (f'<img loading="lazy" src="{escape(one.file)}" alt="What the warning is about">' if one.file else "")
        + "</li>"
        for one in warnings
    )
    return f'<section class="warnings"><h2>What may be wrong</h2><ul>{items}</ul></section>\n'


def _turntable(file: str) -> str:
    return f"""<section><h2>Around the object</h2>
<figure><img class="turntable" src="{escape(file)}" alt="The result seen from a path between the captured cameras">
<figcaption>The result from viewpoints between the captured ones; none of them was used by any step.</figcaption>
</figure></section>
"""


def _numbers(report: "Report") -> str:
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


def _steps(steps: "Sequence[StepTime]", machine: str) -> str:
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
