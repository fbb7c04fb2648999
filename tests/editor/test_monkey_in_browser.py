"""Random clicks, drags and typing, from a fixed seed; afterwards the project opens, and undo works.

SPLATGRAFT_MONKEY_SECONDS sets how long it lasts; two minutes is the full length. What it does, and
when, is written to actions.log in the test's folder.
"""

import os
import random
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from editor_driver import Editor, Window
from test_hostile_values import made, project

from splatgraft.commands.edit_project import FlowProject
from splatgraft.editor.session.session import Session

__all__ = ["made", "project"]
SECONDS = float(os.environ.get("SPLATGRAFT_MONKEY_SECONDS", "30"))
SEED = 17
WIDTH, HEIGHT = 1280, 900
KEYS = (
    "g",
    "d",
    "b",
    "s",
    "Delete",
    "Escape",
    "ArrowLeft",
    "ArrowRight",
    "Control+z",
    "Control+Shift+z",
    "Tab",
    "Enter",
)
ACTIONS = ("click", "drag", "key", "button", "field", "wheel")
TEXTS = ("0", "-1", "1e30", "nan", "", "0.5", "-", "../../..", "/dev/null", "<b>x</b>", "\u0000", "9" * 400)


def act(window: Window, random_: random.Random, note: Callable[[str], None]) -> None:
    """One random action of a user."""
    page = window.page
    kind = random_.randrange(6)
    x, y = random_.uniform(5, WIDTH - 5), random_.uniform(5, HEIGHT - 5)
    note(f"{ACTIONS[kind]} {x:.0f} {y:.0f}")
    if kind == 0:
        page.mouse.click(x, y)
    elif kind == 1:
        window.drag((x, y), (random_.uniform(-200, 200), random_.uniform(-200, 200)))
    elif kind == 2:
        page.keyboard.press(random_.choice(KEYS))
    elif kind == 3:
        # the panel is where most can go wrong
        buttons = page.get_by_role("button").all()
        if buttons:
            chosen = random_.choice(buttons)
            note(str(chosen.text_content(timeout=1000)))
            chosen.click(timeout=1000)
    elif kind == 4:
        fields = page.locator("input:not([type=hidden]):not([type=file])").all()
        if fields:
            field = random_.choice(fields)
            # viser's own setting: with another address the page would be of no server for the rest of the time
            if field.input_value(timeout=1000).startswith("ws://"):
                return
            field.fill(random_.choice(TEXTS), timeout=1000)
            field.press("Enter", timeout=1000)
    else:
        page.mouse.wheel(0, random_.uniform(-300, 300))


def act_for(seconds: float, window: Window, *, log: Path) -> int:
    """Random actions for a time; gives their number."""
    from playwright.sync_api import Error as PlaywrightError

    random_, start, done = random.Random(SEED), time.monotonic(), 0
    with log.open("w", buffering=1) as lines:

        def note(text: str) -> None:
            lines.write(f"{time.monotonic() - start:.1f} {text}\n")

        while time.monotonic() < start + seconds:
            # an element that is gone or covered is not clicked
            with suppress(PlaywrightError):
                act(window, random_, note)
            done += 1
        note("done")
    return done


def test_random_actions_leave_a_project_that_opens(browser: Any, project: Path) -> None:
    editor = Editor(project)
    try:
        window = Window.opened(browser, editor)
        window.show_phase("Place")
        assert act_for(SECONDS, window, log=project.parents[1] / "actions.log") > 5
        # the page still answers
        window.page.keyboard.press("Escape")
        window.page.reload()
        window.page.wait_for_selector(".sg-header")
        assert editor.process.poll() is None
        assert window.unknown_errors() == []
        window.page.close()
        assert editor.end() == 0
    finally:
        if editor.process.poll() is None:
            editor.kill()
    log = editor.log.read_text()
    assert "Traceback" not in log, log[-3000:]
    session = Session(FlowProject(project)) if project.is_file() else None
    if session is not None:
        assert session.notice is None
        while session.undo():
            pass
        Session(FlowProject(project))
