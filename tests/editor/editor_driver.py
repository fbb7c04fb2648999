"""A real browser on a real `splatgraft edit`: what the stories of the editor are told with."""

import io
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatgraft.editor.session.edit_state import EditState, read_state

ARGUMENTS = (
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-dev-shm-usage"),
    # Mesa's software GL: a third of the time that the browser's own takes
    *("--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"),
)


KNOWN_COMPLAINTS = (
    # viser draws splats on a quad whose corners have no z; three then finds no sphere around it, and never hides it
    "Computed radius is NaN",
    # three's controls, on a touch or a wheel
    "Unable to preventDefault inside passive event listener",
)


def browser_path() -> str:
    """Chromium of the system; a machine without one must say so on purpose."""
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
    """A browser with nothing open."""
    path = browser_path()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        context = driver.chromium.launch_persistent_context(
            folder, executable_path=path, headless=True, args=list(ARGUMENTS), viewport={"width": 1280, "height": 900}
        )
        yield context
        context.close()


class Editor:
    """One server on one project."""

    def __init__(self, project: Path, *options: str) -> None:
        """Start it and wait for its address."""
        words = [sys.executable, "-m", "splatgraft", "edit", str(project), "--port", "18080", *options]
        self.log = project.parent / "server.log"
        with self.log.open("ab") as errors:
            self.process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=errors, text=True)
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()
        assert self.url.startswith("http://"), self.log.read_text()[-2000:]

    def kill(self) -> None:
        """As a power cut would."""
        self.process.kill()
        self.process.wait(20)
        self._close()

    def end(self) -> int:
        """As Ctrl-C would; the exit status."""
        self.process.send_signal(signal.SIGINT)
        status = self.process.wait(30)
        self._close()
        return status

    def _close(self) -> None:
        assert self.process.stdout is not None
        self.process.stdout.close()


class Window:
    """One page of the editor, with the words of a person."""

    def __init__(self, page: Any) -> None:
        """A browser's page, opened on the editor already."""
        self.page = page
        self.complaints: list[str] = []
        page.on("console", lambda said: self.complaints.append(said.text) if said.type == "error" else None)
        page.wait_for_selector(".sg-header", timeout=60_000)

    @staticmethod
    def opened(browser: Any, editor: Editor) -> "Window":
        """A new window on an editor."""
        page = browser.new_page()
        page.goto(editor.url)
        return Window(page)

    def turn(self, phase: str) -> None:
        """To another step."""
        self.page.get_by_role("button", name=re.compile(f"^(● )?{phase}$")).click()
        self.page.get_by_role("button", name=f"● {phase}", exact=True).wait_for(timeout=20_000)

    def click(self, name: str) -> None:
        """A button by its label."""
        self.page.get_by_role("button", name=name, exact=True).click()

    def field(self, label: str) -> Any:
        """The last input in the row of a label: of a slider that is its number."""
        row = f'//label[normalize-space()="{label}"]/ancestor::div[contains(@class, "mantine-Flex-root")][1]'
        return self.page.locator(f"xpath={row}//input[not(@type='hidden')]").last

    def write(self, label: str, text: str) -> None:
        """Type into a field."""
        self.field(label).fill(text)
        self.field(label).press("Enter")

    def write_all(self, label: str, numbers: Sequence[float]) -> None:
        """Type into the fields of a vector."""
        row = f'//label[normalize-space()="{label}"]/ancestor::div[contains(@class, "mantine-Flex-root")][1]'
        inputs = self.page.locator(f"xpath={row}//input[not(@type='hidden')]")
        for index, number in enumerate(numbers):
            inputs.nth(index).fill(str(number))
            inputs.nth(index).press("Enter")
            # the page sends back what it took, all numbers of it
            self.page.wait_for_timeout(400)

    def unfold(self, folder: str) -> None:
        """Open a folder of controls."""
        self.page.get_by_text(folder, exact=True).click()

    def upload(self, button: str, path: Path) -> None:
        """A file by an upload button."""
        with self.page.expect_file_chooser() as chooser:
            self.click(button)
        chooser.value.set_files(str(path))

    def check(self, label: str) -> None:
        """A checkbox by its label."""
        self.field(label).click()

    def choose(self, label: str, option: str) -> None:
        """An entry of a dropdown."""
        self.field(label).click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def says(self, text: str, *, timeout: float = 60) -> None:
        """Wait until the page says so."""
        self.page.get_by_text(text).first.wait_for(timeout=timeout * 1000)

    def drag(self, start: tuple[float, float], by: tuple[float, float], *, release: bool = True) -> None:
        """Press at `start`, move and let go."""
        mouse = self.page.mouse
        mouse.move(*start)
        mouse.down()
        for step in range(1, 9):
            mouse.move(start[0] + by[0] * step / 8, start[1] + by[1] * step / 8)
            self.page.wait_for_timeout(60)
        if release:
            mouse.up()

    def handle_of_the_gizmo(self) -> tuple[float, float]:
        """Where the vertical arrow of the gizmo is: the bluest place of the canvas."""
        # after it stands still: a screenshot of a canvas that is drawn in software may be one frame late
        self.page.wait_for_timeout(1500)
        wait_until(lambda: len(self._blue()[0]) > 20, timeout=20, what="the gizmo's blue arrow")
        rows, columns = self._blue()
        top = rows.argsort()[: max(10, len(rows) // 8)]
        return float(np.median(columns[top])), float(np.median(rows[top]))

    def _blue(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of viser's blue for z; the panels have none of it."""
        picture = np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")).astype(int)
        rows, columns = (abs(picture - np.array([48, 144, 240])).sum(-1) < 90).nonzero()
        return rows, columns

    def unknown_complaints(self) -> list[str]:
        """What the browser's console says but for what viser is known to cause."""
        return [text for text in self.complaints if not any(known in text for known in KNOWN_COMPLAINTS)]

    def quiet(self, *, timeout: float = 120) -> None:
        """Wait until no job is shown."""
        self.page.wait_for_selector(".sg-job", state="detached", timeout=timeout * 1000)


def state_of(project: Path) -> EditState:
    """What the files say once the editor, which writes them one after another, is between two changes."""
    for _ in range(20):
        try:
            return read_state(project)
        except ValueError:
            time.sleep(0.1)
    return read_state(project)


def wait_until(true: Callable[[], bool], *, timeout: float, what: str) -> None:
    """Poll; fail with `what` where it never becomes true."""
    end = time.monotonic() + timeout
    while not true():
        assert time.monotonic() < end, f"waited {timeout} s for {what}"
        time.sleep(0.1)
