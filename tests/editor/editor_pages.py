"""A project of two tiny scenes, and the real editor on it, with the messages that a browser would send."""

import http.client
import io
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from tiny_project import ball, plane
from waiting import HANG_LIMIT, wait_until
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from splatgraft.cli import main
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.editor.editor import Editor
from splatgraft.editor.project import Project
from splatgraft.editor.server import Server
from splatgraft.formats import write_gaussians
from splatgraft.project.toml_edit import with_keys

AROUND_THE_BALL = [-0.35, -0.35, 0.03, 0.35, 0.35, 0.65]
TOKEN = "secret"


def scene_project(root: Path, *, suffix: str = ".ply", target: Gaussians | None = None, **segment: object) -> Path:
    """Write two scene files and a project of them, and return project.toml. The target is a plane by default."""
    scenes = [concatenate([plane((0.3, 0.5, 0.3)), ball()]), plane((0.5, 0.45, 0.6)) if target is None else target]
    paths = [root / f"{name}{suffix}" for name in ("source", "target")]
    for path, scene in zip(paths, scenes, strict=True):
        write_gaussians(path, scene)
    project = root / "project" / "project.toml"
    assert main(["init", str(project.parent), "--source", str(paths[0]), "--target", str(paths[1])]) == 0
    box = {"box": AROUND_THE_BALL, "mask_source": "box"}
    text = with_keys(project.read_text(), "segment", {"keep": "all", "solidify": 4, **box, **segment})
    for side in ("source", "target"):
        text = with_keys(text, side, {"views": 8, "picture_width": 160})
    text = with_keys(text, "compose", {"point": [0.0, 0.0, 0.5], "scale": 0.8})
    # a third of the time of a light transfer
    text = with_keys(text, "relight", {"most_added": 0.0})
    project.write_text(with_keys(text, "consolidate", {"passes": 1}))
    return project


@contextmanager
def served() -> Iterator[Server]:
    """Return a server without an editor, at a free port."""
    server = Server(TOKEN, host="127.0.0.1", port=0)
    try:
        yield server
    finally:
        server.close()


@contextmanager
def opened_editor(project: Path) -> Iterator[Editor]:
    """Return the editor on a project, which need not exist."""
    with served() as server:
        editor = Editor(server, Project(project))
        try:
            yield editor
        finally:
            editor.close()


class Client:
    """A window without a browser: it sends what the page sends, and acknowledges pictures."""

    def __init__(self, port: int, token: str = TOKEN) -> None:
        self.port, self.cookie = port, f"splatgraft_token_{port}={token}"
        self.panel: dict[str, Any] = {}
        self.head: dict[str, Any] = {}
        self.pixels = np.zeros((0, 0, 3), np.uint8)
        self.heads: list[dict[str, Any]] = []

    def get(self, path: str, **headers: str) -> int:
        return self.request("GET", path, **headers)[0]

    def request(self, method: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, str]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=HANG_LIMIT)
        connection.request(method, path, body, headers={"Cookie": self.cookie} | headers)
        answer = connection.getresponse()
        found = answer.status, answer.read().decode("utf-8", "replace")
        connection.close()
        return found

    def connect(self, *, origin: str | None = None, cookie: str | None = None) -> ClientConnection:
        here = f"127.0.0.1:{self.port}"
        return connect(
            f"ws://{here}/socket",
            origin=origin or f"http://{here}",  # pyright: ignore[reportArgumentType]
            additional_headers={"Cookie": self.cookie if cookie is None else cookie},
            max_size=None,
            close_timeout=1,
        )

    @contextmanager
    def window(self, *, size: tuple[int, int] | None = None) -> Iterator["Client"]:
        """Open a window with a complete panel; with a size it gets pictures, too."""
        with self.connect() as self.socket:
            self.panel = {}
            self.wait(lambda: bool(self.panel), what="the panel")
            if size is not None:
                self.send("size", w=size[0], h=size[1])
            yield self

    def send(self, kind: str, **rest: Any) -> None:
        self.socket.send(json.dumps({"t": kind, **rest}))

    def wait(self, condition: Callable[[], bool], *, what: str) -> None:
        wait_until(condition, what=f"{what}; the page says {self.panel.get('status')!r}", pause=self.listen)

    def listen(self, seconds: float = 0.05) -> None:
        """Read what the server sends within a time."""
        with suppress(TimeoutError):
            content = self.socket.recv(timeout=seconds)
            if isinstance(content, str):
                self.panel = json.loads(content)
            else:
                length = int.from_bytes(content[:4], "little")
                self.head = json.loads(content[4 : 4 + length])
                self.heads.append(self.head)
                self.pixels = np.asarray(Image.open(io.BytesIO(content[4 + length :])).convert("RGB"))
                self.send("ack", n=self.head["n"])

    def says(self, text: str) -> None:
        """Wait until the status line or a note holds a text."""
        self.wait(lambda: text in self.texts(), what=f"{text!r} on the page")

    def texts(self) -> str:
        notes = [one.get("text", "") for one in self.panel.get("controls", [])]
        return "\n".join([self.panel.get("status", ""), *notes])

    def control(self, name: str) -> dict[str, Any]:
        found = next((one for one in self.panel["controls"] if one["id"] == name), None)
        assert found is not None, f"{name} is not among {[one['id'] for one in self.panel['controls']]}"
        return found

    def has(self, name: str) -> bool:
        return any(one["id"] == name for one in self.panel.get("controls", []))

    def do(self, name: str, value: Any = None) -> None:
        """Use a control, as soon as it is there."""
        self.wait(lambda: self.has(name), what=f"the control {name}")
        self.send("do", id=name, value=value)

    def step(self, name: str) -> None:
        self.send("step", to=name)
        self.wait(lambda: [name, "●"] in self.panel["steps"], what=f"the step {name}")

    def settled(self, width: int, height: int) -> None:
        """Wait for a picture of full size of another canvas, which comes behind all that was sent before."""
        assert self.pixels.shape[1] != width
        self.send("size", w=width, h=height)
        self.wait(lambda: self.pixels.shape[1] == width and self.head["full"], what="the picture at rest")

    def finished(self) -> None:
        """Wait for a picture of full size of the present state."""
        count = len(self.heads)
        self.wait(lambda: len(self.heads) > count and self.head["full"], what="a picture of full size")

    def shows(self, step: str) -> None:
        """Wait for a picture of full size of a step."""
        self.wait(lambda: self.head.get("step") == step and self.head["full"], what=f"a picture of {step}")

    def closed_with(self) -> tuple[int | None, str | None]:
        """Read until the server closes the window."""
        with suppress(ConnectionClosed):
            while True:
                self.socket.recv()
        return self.socket.close_code, self.socket.close_reason


def cloud(count: int, seed: int) -> Gaussians:
    """Return random Gaussians of SH degree 1."""
    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.rand(count, 3, generator=generator),
        log_scales=-3 + torch.rand(count, 3, generator=generator),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        opacity_logits=torch.randn(count, generator=generator),
        sh=torch.rand(count, 4, 3, generator=generator),
    )
