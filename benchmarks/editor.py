"""Measure times of the editor: start, first picture, a moved view, a dragged object and its light.

`python benchmarks/editor.py [--against SRC] [COUNT ...]`. `--against` also measures another checkout's `src`.

For targets of 200,000 Gaussians (or COUNT) it starts `splatgraft edit` on a project of two synthetic scenes, with a
target of SH degree 3. It speaks the page's own protocol through a websocket, at a canvas of 1280x720. No browser takes
part, so a browser's time for drawing is not included.

Times are seconds from the message that causes a picture to its arrival, medians of REPEATS. `final` is the light as the
step computes it. The first points of a large scene are a sample. A drag lasts DRAG_SECONDS. It uses the requests of the
page's script if the page has one, else its gizmo. `draft` and `final` after a drag count from the release.
"""

import argparse
import contextlib
import html
import http.client
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import msgspec
import numpy as np
import torch
import zstandard
from relight import courtyard, surfels
from websockets.sync.client import ClientConnection, connect

from splatgraft.cli import main as command
from splatgraft.core.cameras import look_at
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.formats import write_gaussians
from splatgraft.project.toml_edit import with_keys

WIDTH, HEIGHT, REPEATS, HANG_LIMIT = 1280, 720, 5, 600.0
DRAG_SECONDS = 3.0
BALL_BOX = [-0.35, -0.35, 0.02, 0.35, 0.35, 0.75]


def ball(count: int) -> Gaussians:
    directions = even_directions(count)
    return surfels(0.3 * directions + torch.tensor([0, 0, 0.33]), directions, 0.02, 0.4)


def write_project(root: Path, count: int) -> Path:
    """Write two scenes without photographs, and run all steps up to the pasted object."""
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
        assert command(["run", str(project), "--to", "compose"]) == 0
    return project


class Client:
    """Websocket client that speaks the page's protocol."""

    def __init__(self, address: str) -> None:
        """Connect without sending anything."""
        base, _, query = address.partition("/?")
        self.address = address
        self._socket: ClientConnection = connect(
            base.replace("http", "ws") + "/?" + query,
            origin=base,  # pyright: ignore[reportArgumentType]
            subprotocols=["viser-v1.1.1"],  # pyright: ignore[reportArgumentType]
            max_size=None,
            open_timeout=HANG_LIMIT,
            # unread messages fill the queue, and then no answer to the close arrives
            close_timeout=1.0,
        )
        self._gui: dict[str, dict[str, Any]] = {}
        self.scenes: set[str] = set()

    def close(self) -> None:
        """End the connection."""
        self._socket.close()

    def send(self, kind: str, **fields: Any) -> None:
        """Send a message as viser's page would."""
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look(self, angle: float, *, distance: float = 2.5) -> None:
        """Report a view from a direction."""
        eye = torch.tensor([[distance * np.cos(angle), distance * np.sin(angle), 1.2]]).float()
        pose = look_at(eye, torch.tensor([0.0, 0.0, 0.3]), torch.tensor([0.0, 0.0, 1.0]))[0]
        rotation = quaternion_from_rotation(pose[None, :3, :3])[0]
        self.send(
            "ViewerCameraMessage",
            wxyz=rotation.tolist(),
            position=eye[0].tolist(),
            fov=0.9,
            near=0.01,
            far=1000.0,
            image_height=HEIGHT,
            image_width=WIDTH,
            look_at=[0.0, 0.0, 0.3],
            up_direction=[0.0, 0.0, 1.0],
        )

    def set_value(self, label: str, value: Any) -> None:
        """Change a control."""
        uuid = next(key for key, props in self._gui.items() if props.get("label") == label)
        self.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})

    def value(self, label: str) -> Any:
        """Return the value of a control."""
        return next(props for props in self._gui.values() if props.get("label") == label)["value"]

    def messages(self, seconds: float) -> Iterator[dict[str, Any]]:
        """Yield the messages that arrive within a time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                data = self._socket.recv(timeout=left)
            except TimeoutError:
                return
            assert isinstance(data, bytes)
            packed = int.from_bytes(data[8:16], "little")
            size = int.from_bytes(data[:8], "little")
            inner = zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed], max_output_size=size)
            for message in msgspec.msgpack.decode(inner)["messages"]:
                self._note(message)
                yield message

    def _note(self, message: dict[str, Any]) -> None:
        if "uuid" in message and isinstance(message.get("props"), dict):
            self._gui[message["uuid"]] = {**message["props"], "value": message.get("value")}
        elif message["type"] == "GuiUpdateMessage" and message["uuid"] in self._gui:
            self._gui[message["uuid"]].update(message["updates"])
        if message["type"] in ("GaussianSplatsMessage", "PointCloudMessage"):
            self.scenes.add(message["name"])

    def caption(self) -> str:
        """Return the page's label of the picture."""
        return " ".join(str(p.get("content")) for p in self._gui.values() if "sg-caption" in str(p.get("content")))

    def script_state(self) -> dict[str, Any]:
        """Return the last state sent to the page's script, empty if the page has no script."""
        for props in self._gui.values():
            found = re.search(r'class="sg-state"[^>]*>([^<]*)<', str(props.get("content")))
            if found:
                return json.loads(html.unescape(found[1]))
        return {}

    def ask(self, what: str, **query: Any) -> bytes:
        """Send a request as the page's script would."""
        parts = urlsplit(self.address)
        connection = http.client.HTTPConnection(parts.netloc, timeout=HANG_LIMIT)
        given = urlencode({"window": self.script_state()["window"], **query})
        connection.request("GET", f"/hand/{what}?{given}&{parts.query}")
        answer = connection.getresponse()
        assert answer.status in (200, 204), answer.read()
        return answer.read()

    def until(self, condition: Callable[[], bool]) -> float:
        """Return the seconds until a condition holds."""
        start = time.monotonic()
        while not condition():
            assert time.monotonic() - start < HANG_LIMIT
            for _ in self.messages(0.02):
                if condition():
                    break
        return time.monotonic() - start

    def picture(self) -> float:
        """Return the seconds until the next picture on the canvas."""
        start = time.monotonic()
        while time.monotonic() - start < HANG_LIMIT:
            for message in self.messages(1.0):
                if is_picture(message):
                    return time.monotonic() - start
        raise AssertionError("no picture")


def is_picture(message: dict[str, Any]) -> bool:
    # a picture without depth is the last one, behind the splats of a moving view
    return (
        message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None and bool(message["depth_data"])
    )


def is_final(client: Client) -> bool:
    caption = client.caption()
    return "Light transfer" in caption and "draft" not in caption and "computing" not in caption


def measure(project: Path, source: Path | None) -> dict[str, float]:
    start, found = time.monotonic(), {}
    environment = os.environ | {"PYTHONUNBUFFERED": "1"} | ({} if source is None else {"PYTHONPATH": str(source)})
    words = [sys.executable, "-m", "splatgraft", "edit", str(project), "--port", "18400", "--keep-closed"]
    server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert server.stdout is not None
        client = Client(server.stdout.readline().strip())
        found["page"] = time.monotonic() - start
        client.look(0.0)
        opened = {
            "first points": lambda message: bool(client.scenes),
            "all splats": lambda message: "/target/scene" in client.scenes,
            "first picture": is_picture,
        }
        while opened:
            for message in client.messages(0.05):
                for name in [name for name, has_come in opened.items() if has_come(message)]:
                    found[name] = time.monotonic() - start
                    del opened[name]
        client.until(lambda: is_final(client))
        found["final light"] = time.monotonic() - start
        found |= {"moved view": statistics.median([_turn(client, 0.3 * (k + 1)) for k in range(REPEATS)])}
        found |= {"moved object": statistics.median([_move(client, k) for k in range(REPEATS)])}
        found["final after a move"] = client.until(lambda: is_final(client))
        found |= _drag(client)
    finally:
        server.terminate()
        server.wait(60)
    return found


def _turn(client: Client, angle: float) -> float:
    for step in range(6):
        client.look(angle - 0.05 * (6 - step))
        time.sleep(0.03)
    client.look(angle)
    return client.picture()


def _drag(client: Client) -> dict[str, float]:
    """Return pictures a second during a drag, and seconds from its end to the draft of the light and to the light."""
    client.until(lambda: is_final(client))
    pictures, start = 0, time.monotonic()
    if client.script_state():
        for _ in client.messages(1.0):
            pass
        start = time.monotonic()
        client.ask("grab", object=0, mode="move", x=0.5, y=0.5)
        while (at := time.monotonic() - start) < DRAG_SECONDS:
            assert client.ask("drag", x=0.5 + 0.02 * at, y=0.5 + 0.01 * at)
            pictures += 1
        client.ask("drop", x=0.5 + 0.02 * DRAG_SECONDS, y=0.5 + 0.01 * DRAG_SECONDS)
    else:
        position, wxyz = np.array(client.value("Position")), [1.0, 0.0, 0.0, 0.0]
        client.send("TransformControlsDragStartMessage", name="/gizmo")
        while (at := time.monotonic() - start) < DRAG_SECONDS:
            moved = (position + np.array([0.02 * at, 0.0, 0.0])).tolist()
            client.send("TransformControlsUpdateMessage", name="/gizmo", position=moved, wxyz=wxyz)
            pictures += sum(map(is_picture, client.messages(0.05)))
        client.send("TransformControlsDragEndMessage", name="/gizmo")
    end = time.monotonic()
    client.until(lambda: "a draft of the light" in client.caption())
    draft = time.monotonic() - end
    client.until(lambda: is_final(client))
    return {
        "pictures a second in a drag": pictures / DRAG_SECONDS,
        "draft after it": draft,
        "final after it": time.monotonic() - end,
    }


def _move(client: Client, k: int) -> float:
    client.until(lambda: is_final(client))
    x, y, z = client.value("Position")
    start = time.monotonic()
    client.set_value("Position", [x + 0.02 * (1 if k % 2 else -1), y, z])
    # the earlier picture shows the pasted object or the old light
    client.until(lambda: "a draft of the light" in client.caption())
    return time.monotonic() - start


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--against", type=Path)
    parser.add_argument("counts", nargs="*", type=int, default=[200_000])
    given = parser.parse_args()
    for count in given.counts:
        with tempfile.TemporaryDirectory() as folder:
            made = write_project(Path(folder), count)
            sources = {"now": None} if given.against is None else {"before": given.against, "now": None}
            for name, source in sources.items():
                times = measure(made, source)
                rows = ", ".join(f"{what} {value:.2f}" for what, value in times.items())
                print(f"{count:,} Gaussians, {name}: {rows}", flush=True)
