"""The report's HTML, as one string. Knows words and layout; looks and behaviour are in page.css and page.js."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatgraft.evaluation.report import Report, StepTime

# name, unit, format, whether more is better, what it says
_METRICS = (
    ("psnr", "Whole image", "PSNR, dB", "{:.2f}", True, "Pixel error over all of the picture."),
    ("ssim", "Structure", "SSIM", "{:.4f}", True, "Agreement of local contrast and texture over all of the picture."),
    ("lpips", "Perception", "LPIPS", "{:.4f}", False, "Distance between what a trained network sees in both."),
    (
        "object_psnr",
        "Object",
        "PSNR, dB",
        "{:.2f}",
        True,
        "Only pixels that the object covers: is it lit as it should be?",
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
        "Light left in the shadow over light before, against the same ratio in the truth.",
    ),
    ("rest_psnr", "The rest", "PSNR, dB", "{:.2f}", True, "Pixels that the true object leaves untouched."),
    (
        "rest_max_change",
        "Change of the rest, worst pixel",
        "0 to 1",
        "{:.4f}",
        False,
        "Nothing happens there in the truth, so nothing should here.",
    ),
    ("rest_mean_change", "Change of the rest, mean", "0 to 1", "{:.5f}", False, "The same, averaged."),
)
_CHANGES = (
    ("object_brightness", "Brightness of the object", "{:.2f} x", "Linear light, over copy-paste."),
    (
        "darkened_fraction",
        "Surroundings darkened",
        "{:.1%}",
        "Pixels beside the object that lost over 5% of their light.",
    ),
    ("brightened_fraction", "Surroundings brightened", "{:.1%}", "Pixels beside the object that gained over 5%."),
)


@dataclass(frozen=True)
class ViewFiles:
    """Where one view's pictures lie, relative to the page."""

    name: str
    """The view's name."""
    held_out: bool
    """Whether it was kept from every step before."""
    files: Mapping[str, str]
    """Label to file."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""


def page_html(report: "Report", views: Sequence[ViewFiles], *, turntable: str | None) -> str:
    """The whole page."""
    sections = [
        viewer(views) if views else "",
        _turntable(turntable) if turntable else "",
        _numbers(report),
        _prose("Light", "light", report.light.splitlines()),
        _steps(report.steps, report.machine),
        _list("What to know before trusting this", report.limits),
    ]
    return html_page(report.title, report.subtitle, "".join(sections), views=views)


def html_page(title: str, subtitle: str, sections: str, *, views: Sequence[ViewFiles]) -> str:
    """A page around HTML `sections`, with looks and behaviour inside; `views` is what a `viewer` on it shows."""
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
<footer>Made by splatgraft. This page and the files beside it are all there is; it loads nothing
from elsewhere.</footer>
<script type="application/json" id="views">{data}</script>
<script>
{(here / "page.js").read_text(encoding="utf-8")}</script>
</body>
</html>
"""


def viewer(views: Sequence[ViewFiles]) -> str:
    """Two pictures of one view with a slider between them, and thumbnails of all views."""
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


def _turntable(file: str) -> str:
    return f"""<section><h2>Around the object</h2>
<figure><img class="turntable" src="{escape(file)}" alt="The result seen from a path between the captured cameras">
<figcaption>The result from viewpoints between the captured ones; no step has seen these
pictures.</figcaption>
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
<p>These captures come without ground truth, so no number here can say how right the light is. What can be said is what
the transfer changed.</p>{table}</section>
"""
    metrics = report.metrics
    rows = "".join(_metric_row(metrics, row, report.not_measured) for row in _METRICS)
    held_out = metrics["views"] == "held out"
    said = "that no step has seen" if held_out else "(none was held out: steps before have seen them)"
    return f"""<section><h2>Numbers</h2>
<p>Against ground truth, mean over {metrics["view_count"]} views {said}. Copy-paste is the object as it was captured,
put in place with no light transfer.</p>
<div class="scroll"><table><thead><tr><th scope="col">What</th><th scope="col">Copy-paste</th>
<th scope="col">Result</th><th scope="col">Change</th></tr></thead><tbody>{rows}</tbody></table></div>
<p class="quiet">PSNR and SSIM: higher is better. LPIPS, RMSE and change: lower is better. All views and every single
number are in <a href="metrics.json">metrics.json</a>.</p></section>
"""


def _metric_row(metrics: dict, row: tuple[str, str, str, str, bool, str], reasons: Mapping[str, str]) -> str:
    name, title, unit, form, more_is_better, words = row
    head = f'<tr><th scope="row">{title} <em>{unit}</em><small>{words}</small></th>'
    before, after = metrics["copy_paste"].get(name), metrics["result"].get(name)
    if before is None and after is None:
        asked = name in metrics["result"]
        why = reasons.get(name, "no view has such a region" if asked else "it was not asked for")
        return f'{head}<td colspan="3" class="missing">not measured: {escape(why)}</td></tr>'
    cells = "".join(f"<td>{'-' if value is None else form.format(value)}</td>" for value in (before, after))
    if before is None or after is None:
        return f"{head}{cells}<td></td></tr>"
    change = form.replace("{:", "{:+").format(after - before)
    same = float(change) == 0
    kind = "same" if same else "better" if (after > before) == more_is_better else "worse"
    word = "no change" if same else f"{change} {kind}"
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
    return f"""<section><h2>Time</h2><p>{total} in all{where}.</p>
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
