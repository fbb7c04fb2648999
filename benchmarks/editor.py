"""Measure times of the editor: start, finished picture, orbit, drag, and light, with a browser and without.

`python benchmarks/editor.py [--tree OLD] [--browser] [COUNT ...]`. `--tree` also measures another checkout, first.

For targets of 200,000 Gaussians (or COUNT) it starts `splatgraft edit` on a project of two synthetic scenes, with a
target of SH degree 3, whose result is up to date. It speaks the page's own protocol at a canvas of 1280x720. Times are
seconds from the message that causes a picture to its arrival. An orbit and a drag last SECONDS. With `--browser`,
Chromium without a GPU shows the page, and the pictures that it has drawn count.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from relight import courtyard, surfels
from websockets.sync.client import connect

from splatgraft.cli import main as command
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.formats import write_gaussians
from splatgraft.project.toml_edit import with_keys

WIDTH, HEIGHT, SECONDS, REST, HANG_LIMIT = 1280, 720, 4.0, 5.0, 900.0
BALL_BOX = [-0.35, -0.35, 0.02, 0.35, 0.35, 0.75]


def ball(count: int) -> Gaussians:
    directions = even_directions(count)
    return surfels(0.3 * directions + torch.tensor([0, 0, 0.33]), directions, 0.02, 0.4)


def write_project(root: Path, count: int) -> Path:
    """Write two scenes without photographs, and run all steps up to the light transfer."""
    write_gaussians(root / "source.ply", concatenate([courtyard(20_000), ball(5_000)]))
    write_gaussians(root / "target.ply", courtyard(count).with_sh_degree(3))
    project = root / "project" / "project.toml"
    words = ["--source", str(root / "source.ply"), "--target", str(root / "target.ply")]
    with contextlib.redirect_stdout(sys.stderr):
        assert command(["init", str(project.parent), *words]) == 0
        text = with_keys(
            project.read_text(encoding="utf-8"), "segment", {"keep": "all", "mask_source": "box", "box": BALL_BOX}
        )
        for side in ("source", "target"):
            text = with_keys(text, side, {"views": 8, "picture_width": 320, "up": [0.0, 0.0, 1.0]})
    project.write_text(with_keys(text, "compose", {"point": [0.0, 0.0, 0.5], "scale": 1.0}), encoding="utf-8")
    update(project)
    return project


def update(project: Path) -> None:
    """Run all stale steps up to the light transfer."""
    with contextlib.redirect_stdout(sys.stderr):
        assert command(["run", str(project), "--to", "relight"]) == 0


class Client:
    """Websocket client that speaks the page's protocol and acknowledges each picture."""

    def __init__(self, address: str) -> None:
        """Connect, and tell the size of the canvas."""
        base, _, query = address.partition("/?")
        cookie = f"splatgraft_token_{base.rpartition(':')[2]}={query.removeprefix('token=')}"
        self._socket = connect(
            base.replace("http", "ws") + "/socket",
            origin=base,  # pyright: ignore[reportArgumentType]
            additional_headers={"Cookie": cookie},
            max_size=None,
            open_timeout=HANG_LIMIT,
            close_timeout=1.0,
        )
        self.heads: list[dict[str, Any]] = []
        self.send("size", w=WIDTH, h=HEIGHT)

    def close(self) -> None:
        """End the connection."""
        self._socket.close()

    def send(self, kind: str, **fields: Any) -> None:
        """Send a message as the page would."""
        self._socket.send(json.dumps({"t": kind, **fields}))

    def listen(self, seconds: float) -> None:
        """Take what arrives within a time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                content = self._socket.recv(timeout=left)
            except TimeoutError:
                return
            if isinstance(content, bytes):
                self.heads.append(json.loads(content[4 : 4 + int.from_bytes(content[:4], "little")]))
                self.send("ack", n=self.heads[-1]["n"])

    def until(self, condition: Callable[[dict[str, Any]], bool], *, after: int = 0) -> float:
        """Return the seconds until a picture of which a condition holds."""
        start = time.monotonic()
        while not any(condition(head) for head in self.heads[after:]):
            assert time.monotonic() - start < HANG_LIMIT
            self.listen(0.01)
        return time.monotonic() - start


def is_final(head: dict[str, Any]) -> bool:
    return head["full"] and head["caption"] == "full quality"


@contextlib.contextmanager
def served(project: Path) -> Iterator[str]:
    words = [sys.executable, "-m", "splatgraft", "edit", str(project), "--port", "18400", "--keep-closed"]
    server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"})
    assert server.stdout is not None
    try:
        yield server.stdout.readline().strip()
    finally:
        server.terminate()
        server.wait(60)


def measure(project: Path) -> dict[str, float]:
    start, found = time.monotonic(), {}
    with served(project) as address:
        client = Client(address)
        found["page"] = time.monotonic() - start
        client.until(is_final)
        found["finished picture"] = time.monotonic() - start
        client.listen(1.0)
        found["orbit, pictures a second"] = moved(client, lambda at: client.send("turn", x=0.004, y=0.0))
        found["full picture after it"] = client.until(lambda head: head["full"], after=len(client.heads))
        # the first move needs all layers; later ones are the rule, after the editor has prepared their drafts
        for name in ("first ", ""):
            drag(client, found, name)
            client.listen(REST)
        client.close()
    return found


def moved(client: Client, move: Callable[[float], None]) -> float:
    """Return pictures a second while something moves, sixty times a second."""
    begin, count = time.monotonic(), len(client.heads)
    while (at := time.monotonic() - begin) < SECONDS:
        move(at)
        client.listen(1 / 60)
    return (len(client.heads) - count) / SECONDS


def drag(client: Client, found: dict[str, float], name: str) -> None:
    hull = next(head["hulls"][0] for head in reversed(client.heads) if head.get("hulls"))
    x, y = (sum(values) / len(hull) for values in zip(*hull, strict=True))

    def at(what: str, seconds: float) -> None:
        place = {"x": x + 0.01 * seconds, "y": y + 0.005 * seconds}
        client.send("pointer", what=what, on="object:0", mode="move", **place)

    at("down", 0.0)
    found[f"{name}drag, pictures a second"] = moved(client, lambda seconds: at("move", seconds))
    at("up", SECONDS)
    count, begin = len(client.heads), time.monotonic()
    client.until(lambda head: "draft" in head["caption"] or is_final(head), after=count)
    found[f"{name}draft after it"] = time.monotonic() - begin
    client.until(is_final, after=count)
    found[f"{name}final after it"] = time.monotonic() - begin


def measure_in_browser(project: Path) -> dict[str, float]:
    from playwright.sync_api import sync_playwright

    found = {}
    with served(project) as address, sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        context = driver.chromium.launch_persistent_context(
            folder, headless=True, viewport={"width": WIDTH + 340, "height": HEIGHT}, timeout=1000 * HANG_LIMIT,
            executable_path="/usr/bin/chromium", args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"],
        )  # fmt: skip
        page, start = context.new_page(), time.monotonic()
        page.goto(address)
        while "full full quality" not in (page.evaluate("document.body.dataset.picture") or ""):
            page.wait_for_timeout(20)
        found["browser: finished picture"] = time.monotonic() - start
        page.wait_for_timeout(1500)
        number = "Number(document.body.dataset.picture.split(' ')[0])"
        for name, (x, y) in {"orbit": (80, 80), "drag": (WIDTH // 2, HEIGHT // 2)}.items():
            before, begin = page.evaluate(number), time.monotonic()
            page.mouse.move(x, y)
            page.mouse.down()
            while (at := time.monotonic() - begin) < SECONDS:
                page.mouse.move(x + 30 * at, y + 4 * at)
            found[f"browser: {name}, pictures a second"] = (page.evaluate(number) - before) / SECONDS
            page.mouse.up()
            page.wait_for_timeout(3000)
        context.close()
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--tree", type=Path)
    parser.add_argument("--browser", action="store_true")
    parser.add_argument("counts", nargs="*", type=int, default=[200_000])
    given = parser.parse_args()
    for count in given.counts:
        if given.tree is not None:
            script, paths = given.tree / "benchmarks" / "editor.py", (given.tree / "src", given.tree / "benchmarks")
            environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))}
            print(f"{given.tree}:", flush=True)
            subprocess.run([sys.executable, str(script), str(count)], env=environment, check=True)
        with tempfile.TemporaryDirectory() as folder:
            made = write_project(Path(folder), count)
            times = measure(made)
            if given.browser:
                update(made)  # the drags have moved the object
                times |= measure_in_browser(made)
            rows = ", ".join(f"{what} {value:.2f}" for what, value in times.items())
            print(f"{count:,} Gaussians, now: {rows}", flush=True)
