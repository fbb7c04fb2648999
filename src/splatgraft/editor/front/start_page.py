"""The start page: one card per project with its picture, its state and when it was changed."""

import html
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

from splatgraft.editor.front.project_folders import ProjectFolder
from splatgraft.editor.front.project_states import ProjectState, StateKind

ASSETS = {"start_page.css": "text/css; charset=utf-8", "start_page.js": "text/javascript; charset=utf-8"}
"""Files of the page, with their media types."""
PROJECTS_PATH, THUMBNAILS_PATH, LIST_PATH = "p", "thumbnails", "list"
"""Parts of the addresses below that of the start page."""
_LABELS: dict[StateKind, str] = {
    "unknown": "being read",
    "running": "running",
    "fresh": "up to date",
    "stale": "out of date",
    "part": "unfinished",
    "new": "new",
    "bad": "cannot be read",
}
_MINUTE, _HOUR, _DAY = 60, 3600, 86400


@dataclass(frozen=True)
class ProjectCard:
    """What the page shows of one project."""

    project: ProjectFolder
    """The project."""
    state: ProjectState
    """Its state."""
    windows: int
    """How many windows it is open in."""


def start_page(cards: Sequence[ProjectCard], *, title: str, base: str) -> bytes:
    """The page.

    Args:
        cards: The projects in their order.
        title: Name of the folder that holds them.
        base: Path of the page at the public address; empty: addresses are relative to the page's own.
    """
    return _page(
        f'<main><h1>{html.escape(title)}</h1><p class="count">{_count(len(cards))}</p>'
        f'<ul id="projects">{project_list(cards).decode()}</ul></main><script src="start_page.js" defer></script>',
        title=title,
        base=base,
    )


def project_list(cards: Sequence[ProjectCard]) -> bytes:
    """The cards alone, by which the page renews itself."""
    return "\n".join(_card(card, time.time()) for card in cards).encode()


def waiting_page(project: ProjectFolder, *, base: str) -> bytes:
    """The page that a browser sees until the project's process answers; it loads itself again."""
    body = f'<main class="message"><h1>{html.escape(project.name)}</h1><p>The editor starts ...</p></main>'
    return _page(body, title=project.name, base=base, refresh=True)


def problem_page(project: ProjectFolder, problem: str, others: str, *, base: str) -> bytes:
    """The page that says why a project's process ended.

    Args:
        project: The project.
        problem: Why, in one line.
        others: Label of a link to the start page; empty: no link.
        base: As for `start_page`.
    """
    link = f'<a href="./">{html.escape(others)}</a>' if others else ""
    body = (
        f'<main class="message"><h1>{html.escape(project.name)}</h1><p class="problem">{html.escape(problem)}</p>'
        f'<p><a href="{PROJECTS_PATH}/{project.key}/">Open it again</a>{link}</p></main>'
    )
    return _page(body, title=project.name, base=base)


def asset(name: str) -> bytes:
    """The content of one of `ASSETS`."""
    return files("splatgraft.editor.front").joinpath(name).read_bytes()


def age(changed: float, now: float) -> str:
    """How long ago something was changed, in words; times in seconds since 1970, 0: never."""
    if changed <= 0:
        return "not saved yet"
    spent = now - changed
    if spent < _MINUTE:
        return "changed just now"
    for unit, seconds, below in (("minute", _MINUTE, _HOUR), ("hour", _HOUR, _DAY), ("day", _DAY, 30 * _DAY)):
        if spent < below:
            count = int(spent // seconds)
            return f"changed {count} {unit}{'' if count == 1 else 's'} ago"
    return f"changed on {time.strftime('%Y-%m-%d', time.localtime(changed))}"


def _page(body: str, *, title: str, base: str, refresh: bool = False) -> bytes:
    # addresses in the page are relative to the start page, wherever a proxy has put it
    head = f'<base href="{html.escape(base)}">' + ('<meta http-equiv="refresh" content="1">' if refresh else "")
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">{head}'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)} - splatgraft</title>"
        f'<link rel="icon" href="data:,"><link rel="stylesheet" href="start_page.css"></head><body>{body}</body></html>'
    ).encode()


def _card(card: ProjectCard, now: float) -> str:
    project, state = card.project, card.state
    if state.picture is None:
        picture = '<div class="picture none" aria-hidden="true"><span>no picture yet</span></div>'
    else:
        stamp = state.picture.stat().st_mtime_ns
        picture = f'<img class="picture" src="{THUMBNAILS_PATH}/{project.key}/{stamp}" alt="" width="280" height="175">'
    label = _LABELS[state.kind]
    more = "" if state.text in (label, "") else f'<span class="text">{html.escape(state.text)}</span>'
    windows = "" if not card.windows else f" &middot; open in {_windows(card.windows)}"
    return (
        f'<li data-key="{project.key}" class="{state.kind}"><a href="{PROJECTS_PATH}/{project.key}/">{picture}'
        f'<span class="name">{html.escape(project.name)}</span>'
        f'<span class="state"><b>{label}</b> {more}</span>'
        f'<span class="changed">{age(state.changed, now)}{windows}</span></a></li>'
    )


def _count(number: int) -> str:
    return f"{number} project" + ("" if number == 1 else "s")


def _windows(number: int) -> str:
    return f"{number} window" + ("" if number == 1 else "s")
