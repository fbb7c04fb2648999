"""Driver of `splatgraft edit` in a browser: starts the server, opens windows, and performs a user's actions."""

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from waiting import HANG_LIMIT, act_until, wait_until

from splatgraft.editor.history import StateStore
from splatgraft.editor.jobs import Jobs
from splatgraft.editor.state import EditState
from splatgraft.editor.state_files import read_state

ARGUMENTS = (
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-dev-shm-usage"),
    # Mesa's software OpenGL takes a third of the time of the browser's own
    *("--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"),
)


KNOWN_ERRORS = (
    # viser draws splats on a quad whose corners have no z, so that three.js finds no bounding sphere
    "Computed radius is NaN",
    # the controls of three.js, on a touch or a wheel
    "Unable to preventDefault inside passive event listener",
)


def browser_path() -> str:
    """Return the path of the system's Chromium, else of Playwright's.

    Without any the test fails, or is skipped where SPLATGRAFT_NO_BROWSER gives a reason.
    """
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is not None:
        return found
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        own = playwright.chromium.executable_path
    if Path(own).is_file():
        return own
    reason = os.environ.get("SPLATGRAFT_NO_BROWSER")
    if reason:
        pytest.skip(f"no browser: {reason}")
    pytest.fail("no Chromium found: `make browser`, or set SPLATGRAFT_NO_BROWSER to the reason why there is none")


@contextmanager
def with_browser() -> Iterator[Any]:
    """Start a browser without windows."""
    path = browser_path()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        context = driver.chromium.launch_persistent_context(
            folder,
            executable_path=path,
            headless=True,
            args=list(ARGUMENTS),
            viewport={"width": 1280, "height": 900},
            timeout=1000 * HANG_LIMIT,
        )
        context.set_default_timeout(1000 * HANG_LIMIT)
        yield context
        context.close()


_WATCH_CLICK = """element => {
  window.clickTaken = false;
  const taken = event => { if (event.composedPath().includes(element)) window.clickTaken = true; };
  document.addEventListener("click", taken, {capture: true, once: true});
}"""
"""Script that records whether the next click of the page reaches an element."""


class Editor:
    """A server process on one project."""

    def __init__(self, project: Path, *options: str) -> None:
        """Start the server and wait for its address."""
        # the next free port is taken if another worker has this one
        words = [sys.executable, "-m", "splatgraft", "edit", str(project), "--port", "18080", *options]
        self.log = project.parent / "server.log"
        with self.log.open("ab") as errors:
            self.process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=errors, text=True)
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()
        assert self.url.startswith("http"), self.log.read_text()[-2000:]

    def kill(self) -> None:
        """Kill the process, like a power cut."""
        self.process.kill()
        self.process.wait(HANG_LIMIT)
        self._close()

    def end(self) -> int:
        """Interrupt the process, like Ctrl-C, and return the exit status."""
        self.process.send_signal(signal.SIGINT)
        status = self.process.wait(HANG_LIMIT)
        self._close()
        return status

    def _close(self) -> None:
        assert self.process.stdout is not None
        self.process.stdout.close()
        # pytest shows it if the test fails
        print(self.log.read_text()[-2000:])


class Window:
    """A browser window on the editor, with a user's actions.

    A click on a control is repeated until the page has received it; from there on it is never lost, because messages
    between page and server are ordered. Other actions are repeated until their effect is seen.
    """

    def __init__(self, page: Any) -> None:
        """Wait for the controls of a Playwright page that has opened the editor."""
        self.page = page
        self.errors: list[str] = []
        page.on("console", lambda entry: self.errors.append(entry.text) if entry.type == "error" else None)
        page.wait_for_selector(".sg-header")

    @staticmethod
    def opened(browser: Any, address: str) -> "Window":
        """Open a new window on an editor; one that stays empty is loaded again.

        Where connections failed shortly before, Chromium delays the next one, and viser gives it up after a second.
        """
        from playwright.sync_api import TimeoutError as PlaywrightTimeout

        page = browser.new_page()
        page.goto(address)
        while not page.locator(".sg-header").count():
            try:
                page.wait_for_selector(".sg-header", timeout=30_000)
            except PlaywrightTimeout:
                page.goto(address)
        return Window(page)

    # waiting

    def until(self, condition: Callable[[], bool], *, what: str) -> None:
        """Poll until `condition` holds; the browser's events are processed meanwhile."""
        try:
            wait_until(condition, what=what, pause=self._pause)
        except AssertionError as error:
            error.add_note(f"the preview is called {self.caption()!r}; the browser's last errors: {self.errors[-3:]}")
            raise

    def act_until(self, action: Callable[[], object], effect: Callable[[], bool], *, what: str) -> None:
        """Repeat an action until its effect is seen; an action that times out counts as not done."""
        from playwright.sync_api import TimeoutError as PlaywrightTimeout

        def attempt() -> None:
            with suppress(PlaywrightTimeout):
                action()

        act_until(attempt, effect, what=what, pause=self._pause)

    def _pause(self, seconds: float) -> None:
        self.page.wait_for_timeout(1000 * seconds)

    def says(self, text: str) -> None:
        """Wait until the page shows a text."""
        self.page.get_by_text(text).first.wait_for()

    def shows(self, text: str) -> bool:
        """Return whether the page shows a text now."""
        return self.page.get_by_text(text).first.is_visible()

    def caption(self) -> str:
        """Return the caption of the preview."""
        return " ".join(self.page.locator(".sg-caption").all_text_contents())

    def shows_job(self) -> bool:
        """Return whether the page shows a running job."""
        return self.page.locator(".sg-job").first.is_visible()

    # controls

    def click(self, name: str) -> None:
        """Click a button by its label."""
        self.click_on(self.page.get_by_role("button", name=name, exact=True))

    def click_on(self, locator: Any) -> None:
        """Click an element, and repeat if the page replaced it between press and release of the mouse button."""
        from playwright.sync_api import Error as PlaywrightError

        def attempt() -> None:
            # an element that is replaced before the click raises an error, and then the click was not received
            with suppress(PlaywrightError):
                element = locator.element_handle()
                element.evaluate(_WATCH_CLICK)
                element.click()

        self.page.evaluate("window.clickTaken = false")
        act_until(
            attempt, lambda: self.page.evaluate("window.clickTaken"), what=f"a click on {locator}", pause=self._pause
        )

    def show_phase(self, phase: str) -> None:
        """Switch to a phase."""
        button = self.phase_button(phase)
        current = self.page.get_by_role("button", name=f"\u25cf {phase}", exact=True)
        self.act_until(lambda: self.click_on(button), current.is_visible, what=f"the phase {phase}")

    def phase_button(self, phase: str) -> Any:
        """Return the button of a phase, whatever its mark."""
        return self.page.get_by_role("button", name=re.compile(rf"^(\S )?{phase}$")).first

    def show_more(self) -> None:
        """Open the folder of rare settings."""
        inner = self.page.get_by_text("View", exact=True)
        self.act_until(lambda: self.unfold("More"), inner.is_visible, what="the further controls")

    def inputs(self, label: str) -> Any:
        """Return all inputs in the row of a label."""
        row = f'//label[normalize-space()="{label}"]/ancestor::div[contains(@class, "mantine-Flex-root")][1]'
        return self.page.locator(f"xpath={row}//input[not(@type='hidden')]")

    def field(self, label: str) -> Any:
        """Return the last input in the row of a label; for a slider that is its number."""
        return self.inputs(label).last

    def write(self, label: str, text: str, *, effect: Callable[[], bool] | None = None) -> None:
        """Type into a field until it shows the text, and until `effect` holds if given."""
        field = self.field(label)

        def attempt() -> None:
            field.fill(text)
            field.press("Enter")

        self.act_until(attempt, effect or (lambda: field.input_value() == text), what=f"{text} in the field {label}")

    def write_number(self, label: str, index: int, number: float, *, effect: Callable[[], bool]) -> None:
        """Type one number of a vector until `effect` holds."""
        field = self.inputs(label).nth(index)

        def attempt() -> None:
            field.fill(str(number))
            field.press("Enter")

        self.act_until(attempt, effect, what=f"{number} as number {index} of the field {label}")

    def check(self, label: str, on: bool = True) -> None:
        """Set a checkbox."""
        field = self.field(label)

        def attempt() -> None:
            if field.is_checked() != on:
                field.click()

        self.act_until(attempt, lambda: field.is_checked() == on, what=f"the checkbox {label}")

    def choose(self, label: str, option: str) -> None:
        """Choose an entry of a dropdown."""
        field = self.field(label)

        def attempt() -> None:
            field.click()
            self.page.get_by_role("option", name=option, exact=True).click(timeout=10_000)

        self.act_until(attempt, lambda: field.input_value() == option, what=f"{option} in the dropdown {label}")

    def unfold(self, folder: str) -> None:
        """Open a folder of controls."""
        self.click_on(self.page.get_by_text(folder, exact=True))

    def upload(self, button: str, path: Path) -> None:
        """Upload a file by an upload button."""
        choosers: list[Any] = []

        def opened(chooser: Any) -> None:
            choosers.append(chooser)

        self.page.on("filechooser", opened)
        # a browser opens a file chooser only within seconds of a click: on a busy machine a click may have no effect
        self.act_until(lambda: self.click(button), lambda: bool(choosers), what="a file chooser")
        self.page.remove_listener("filechooser", opened)
        choosers[0].set_files(str(path))

    def download(self, button: str) -> Path:
        """Click a button and wait for the file that it downloads."""
        with self.page.expect_download() as download:
            self.click(button)
        return Path(download.value.path())

    def undo_until(self, project: Path, condition: Callable[[], bool]) -> None:
        """Undo step by step until `condition` holds."""

        store = StateStore(project.parent, project_folder=project.parent)

        def is_in_history() -> bool:
            return store.save(state_of(project)) == history_of(project)["present"]

        while not condition():
            # the history is written after the files
            self.until(is_in_history, what="the files' state in the history")
            count = len(history_of(project)["past"])
            assert count, "no step is left to undo"
            # viser's page may drop a click that follows the last one at once
            self.act_until(
                lambda: self.click("Undo"),
                lambda count=count: len(history_of(project)["past"]) < count,
                what="a step back in the history",
            )

    # the 3D view

    def drag(self, start: tuple[float, float], by: tuple[float, float], *, release: bool = True) -> None:
        """Press the mouse button at `start`, move and release."""
        mouse = self.page.mouse
        mouse.move(*start)
        mouse.down()
        for step in range(1, 9):
            mouse.move(start[0] + by[0] * step / 8, start[1] + by[1] * step / 8)
            # the page draws a frame, as it does for a hand
            self._pause(0.06)
        if release:
            mouse.up()

    def drag_gizmo(self, by: tuple[float, float], effect: Callable[[], bool], *, what: str) -> None:
        """Drag the gizmo's vertical arrow until `effect` holds; the mouse button stays pressed."""

        def attempt() -> None:
            self.page.mouse.up()
            self.drag(self._gizmo_handle(), by, release=False)

        self.act_until(attempt, effect, what=what)

    def _gizmo_handle(self) -> tuple[float, float]:
        """Return the position of the gizmo's vertical arrow, the bluest place of the canvas, after it has stopped."""
        places: list[tuple[float, float]] = []

        def stands_still() -> bool:
            rows, columns = self._blue_pixels()
            if len(rows) <= 20:
                places.clear()
                return False
            top = rows.argsort()[: max(10, len(rows) // 8)]
            places.append((float(np.median(columns[top])), float(np.median(rows[top]))))
            # a screenshot of a canvas that is drawn in software may be a frame late
            self._pause(0.5)
            return len(places) > 2 and np.abs(np.ptp(np.array(places[-3:]), axis=0)).max() < 2

        self.until(stands_still, what="the gizmo's blue arrow")
        return places[-1]

    def _blue_pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns of viser's blue for z; the panels have none of it."""
        picture = np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")).astype(int)
        rows, columns = (abs(picture - np.array([48, 144, 240])).sum(-1) < 90).nonzero()
        return rows, columns

    def unknown_errors(self) -> list[str]:
        """Return errors in the browser's console except those that viser is known to cause."""
        return [text for text in self.errors if not any(known in text for known in KNOWN_ERRORS)]

    # jobs

    def start_job(self, project: Path, button: str) -> None:
        """Click a button and wait until the job that it starts has begun."""
        jobs = jobs_of(project)
        before = jobs.state()

        def has_begun() -> bool:
            state = jobs.state()
            return state is not None and (before is None or state.started > before.started)

        self.click(button)
        self.until(has_begun, what=f"the job of {button}")

    def finish_job(self, project: Path) -> None:
        """Wait until the present job is done and the page no longer shows it."""
        wait_for_job(project)
        self.until(lambda: not self.shows_job(), what="the end of the job on the page")


def jobs_of(project: Path) -> Jobs:
    """Return the jobs of a project."""
    return Jobs(project.parent / ".editor")


def wait_for_job(project: Path) -> None:
    """Wait until the job of a project has ended; fail with its log if it was not successful."""
    jobs = jobs_of(project)
    wait_until(lambda: (state := jobs.state()) is not None and not state.live, what="the end of the job")
    state = jobs.state()
    assert state is not None
    assert state.outcome == "done", f"{state.error}\n{(project.parent / '.editor' / 'job.log').read_text()[-2000:]}"


def history_of(project: Path) -> dict[str, Any]:
    """Return the names of the states in the undo history."""
    return json.loads((project.parent / ".editor" / "history.json").read_text())


def state_of(project: Path) -> EditState:
    """Return the state in the project's files; the editor writes them one by one, so reading may have to wait."""
    found: list[EditState] = []

    def read() -> bool:
        with suppress(ValueError):
            found.append(read_state(project))
        return bool(found)

    wait_until(read, what="a consistent state in the project's files")
    return found[0]
