"""Record the editor in Chromium on the finished demo: an orbit, a lit drag, a turn, and the sun by two clicks.

    splatgraft demo demo && python benchmarks/record_editor.py demo docs/images/editor.webp

The project's placement and light are changed. Each picture is shown as long as it was on the screen, at most a second.
"""

import argparse
import io
import time
from pathlib import Path
from typing import Any

from editor import served
from PIL import Image
from playwright.sync_api import sync_playwright

WINDOW_WIDTH, WINDOW_HEIGHT = 1300, 540
WIDTH, QUALITY, LONGEST_MS = 650, 55, 1000
STEPS, HANG_LIMIT = 14, 300.0
# places in the window, pixels, in the view after the orbit
ORBIT = (700, 60), (665, 105)
DRAG = (700, 400), (530, 350)
TURN = (530, 350), (590, 350)
RIM, TIP = (622, 216), (452, 262)
CURSOR = """addEventListener("DOMContentLoaded", () => {
  const dot = document.body.appendChild(document.createElement("div"));
  Object.assign(dot.style, {position: "fixed", width: "18px", height: "18px", margin: "-9px", borderRadius: "50%",
    border: "2px solid white", background: "#0006", pointerEvents: "none", zIndex: 99});
  addEventListener("pointermove", e => Object.assign(dot.style, {left: e.clientX + "px", top: e.clientY + "px"}), true);
});"""


class Recorder:
    """Pictures of a page, with the times at which they were taken."""

    def __init__(self, page: Any) -> None:
        """Start without pictures."""
        self.page, self._pictures = page, []

    def shoot(self) -> None:
        """Take a picture; it is dropped if it equals the last one."""
        at, shot = time.monotonic(), self.page.screenshot(type="jpeg", quality=95)
        if not self._pictures or shot != self._pictures[-1][1]:
            self._pictures.append((at, shot))

    def drag(self, start: tuple[int, int], end: tuple[int, int]) -> None:
        """Drag the pointer, with pictures on the way."""
        self.page.mouse.move(*start)
        self.page.mouse.down()
        for step in range(1, STEPS + 1):
            x, y = (a + (b - a) * step / STEPS for a, b in zip(start, end, strict=True))
            self.page.mouse.move(x, y)
            self.page.wait_for_timeout(60)
            self.shoot()
        self.page.mouse.up()

    def click(self, at: tuple[int, int]) -> None:
        """Click at a place."""
        self.page.mouse.move(*at)
        self.shoot()
        self.page.mouse.click(*at)
        self.page.wait_for_timeout(300)
        self.shoot()

    def until_full_quality(self, *, at_least: float = 0.5) -> None:
        """Take pictures until the page shows the finished light, and for some seconds."""
        begin = time.monotonic()
        while time.monotonic() - begin < at_least or "full full quality" not in (
            self.page.get_attribute("body", "data-picture") or ""
        ):
            assert time.monotonic() - begin < HANG_LIMIT
            self.shoot()
            self.page.wait_for_timeout(250)
        self.shoot()

    def write(self, file: Path) -> None:
        """Write an animated WebP."""
        times, shots = zip(*self._pictures, strict=True)
        images = [Image.open(io.BytesIO(shot)).convert("RGB") for shot in shots]
        images = [
            image.resize((WIDTH, WIDTH * image.height // image.width), Image.Resampling.LANCZOS) for image in images
        ]
        spans = [min(LONGEST_MS, int(1000 * (b - a))) for a, b in zip(times, [*times[1:], times[-1] + 2], strict=True)]
        images[0].save(file, save_all=True, append_images=images[1:], duration=spans, loop=0, quality=QUALITY, method=6)


def record(project: Path, file: Path) -> None:
    """Act as a user would, and write the recording."""
    with served(project) as address, sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path="/usr/bin/chromium", args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        )
        page = browser.new_page(viewport={"width": WINDOW_WIDTH, "height": WINDOW_HEIGHT})
        page.add_init_script(CURSOR)
        page.goto(address)
        recorder = Recorder(page)
        page.wait_for_selector("#steps button")
        while "full full quality" not in (page.get_attribute("body", "data-picture") or ""):
            page.wait_for_timeout(100)
        recorder.shoot()
        page.wait_for_timeout(8000)  # drafts are prepared
        recorder.drag(*ORBIT)
        recorder.until_full_quality()
        recorder.drag(*DRAG)
        recorder.until_full_quality()
        page.keyboard.press("r")
        recorder.drag(*TURN)
        recorder.until_full_quality()
        page.click("#steps button[data-step=Light]")
        recorder.until_full_quality()
        page.locator("[data-id=sun]").click(timeout=1000 * HANG_LIMIT)
        recorder.click(RIM)
        recorder.click(TIP)
        recorder.until_full_quality(at_least=5.0)
        browser.close()
    recorder.write(file)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("file", type=Path)
    given = parser.parse_args()
    record(given.project / "project.toml", given.file)
