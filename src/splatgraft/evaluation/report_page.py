"""An HTML page that works offline, and in it a viewer that compares pictures of views.

Style and scripts are in page.css and page.js.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from importlib.resources import files


@dataclass(frozen=True)
class ViewFiles:
    """The picture files of one view, with paths relative to the page."""

    name: str
    """The view's name."""
    held_out: bool
    """Whether no step before the evaluation used a picture of this view."""
    files: Mapping[str, str]
    """File of each picture, by its label."""
    width: int
    """Width of the pictures, pixels."""
    height: int
    """Height of the pictures, pixels."""


def html_page(title: str, subtitle: str, sections: str, *, views: Sequence[ViewFiles]) -> str:
    """Format a page with style and scripts around HTML `sections`; its `viewer` shows `views`."""
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
