"""Messages that no page sends are refused in one line and in bounded memory, and the page continues."""

import contextlib
import http.client
import json
import os
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgspec.msgpack
import pytest
import viser
import zstandard
from editor_driver import Editor
from editor_pages import TOKEN, opened_page
from waiting import HANG_LIMIT, act_until, wait_until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Close, CloseCode
from websockets.sync.client import ClientConnection, connect

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [1.0, 1.0, 1.0],
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
    "image_width": 800,
    "image_height": 600,
}
IDENTITY = [[float(row == column) for column in range(4)] for row in range(4)]
PART = 1 << 19
"""Size of a part of an upload in viser's page, bytes."""


def encode(message: object) -> bytes:
    return msgspec.msgpack.encode(message)


class Client:
    """Client that knows the token, instead of the page."""

    def __init__(self, port: int, token: str) -> None:
        self.port, self.cookie = port, f"splatgraft_token_{port}={token}"
        self.controls: dict[str, dict[str, Any]] = {}
        """Properties of the page's controls, by their ids."""
        self.said: list[str] = []
        """Texts of the page, in order of arrival."""

    def get(self, path: str, **headers: str) -> int:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=HANG_LIMIT)
        connection.request("GET", path, headers={"Cookie": self.cookie} | headers)
        status = connection.getresponse().status
        connection.close()
        return status

    def connect(self, *, origin: str | None = None, cookie: str | None = None, protocol: str = "") -> ClientConnection:
        here = f"127.0.0.1:{self.port}"
        return connect(
            f"ws://{here}",
            origin=origin or f"http://{here}",  # pyright: ignore[reportArgumentType]
            subprotocols=[protocol or f"viser-v{viser.__version__}"],  # pyright: ignore[reportArgumentType]
            additional_headers={"Cookie": self.cookie if cookie is None else cookie},
            max_size=None,
        )

    @contextlib.contextmanager
    def window(self) -> Iterator[ClientConnection]:
        """Return a window with a complete page."""
        with self.connect() as window:
            window.send(encode(CAMERA))
            self.wait(window, lambda: "ReplayDoneMessage" in self.said and self._is_complete(), what="the page")
            yield window
        self.said.clear()
        # answered after the server has noticed the end of the window, so that the next one edits
        assert self.get("/") == 200

    def _is_complete(self) -> bool:
        return any(props.get("label") == "History" for props in self.controls.values())

    def wait(self, window: ClientConnection, condition: Callable[[], bool], *, what: str) -> None:
        """Read messages of the server until the condition holds."""
        wait_until(condition, what=what, pause=partial(self._listen, window))

    def finds(self, window: ClientConnection, path: str, text: str) -> None:
        """Write a path into a field until the page answers with this text; messages before a window edits are lost."""
        self.said.clear()
        act_until(
            lambda: self.set(window, "Place into", path + " " * random.randrange(1, 99)),
            lambda: any(text in said for said in self.said),
            what=text,
            pause=partial(self._listen, window),
        )

    def works(self, window: ClientConnection) -> None:
        """Assert that the page answers to this window."""
        # another name each time, because an unchanged text is not sent again
        self.finds(window, f"nowhere_{random.randrange(1 << 30)}", "found nothing there")

    def _listen(self, window: ClientConnection, seconds: float) -> None:
        with contextlib.suppress(TimeoutError):
            self._take(bytes(window.recv(timeout=seconds)))

    def _take(self, sent: bytes) -> None:
        # viser's format: sizes of the message unpacked and packed, the message, buffers of arrays
        unpacked, packed = struct.unpack("<QQ", sent[:16])
        content = zstandard.ZstdDecompressor().decompress(sent[16 : 16 + packed], max_output_size=unpacked)
        for message in msgspec.msgpack.decode(content)["messages"]:
            self.said.append(message["type"])
            props = message.get("props") or message.get("updates") or {}
            self.said += [str(props[name]) for name in ("content", "value", "body") if name in props]
            if "props" in message and "uuid" in message:
                self.controls[message["uuid"]] = message["props"]

    def control(self, label: str) -> str:
        return next(uuid for uuid, props in self.controls.items() if props.get("label") == label)

    def set(self, window: ClientConnection, label: str, value: object) -> None:
        window.send(encode({"type": "GuiUpdateMessage", "uuid": self.control(label), "updates": {"value": value}}))

    def upload(self, window: ClientConnection, name: str, data: bytes, *, size: int | None = None) -> None:
        source = {"source_component_uuid": self.control("Upload a video or a scene"), "transfer_uuid": name}
        parts = [data[start : start + PART] for start in range(0, len(data), PART)]
        about = {"filename": name, "mime_type": "", "part_count": len(parts)}
        start = {"type": "FileTransferStartUpload", "size_bytes": len(data) if size is None else size}
        window.send(encode(start | source | about))
        for index, content in enumerate(parts):
            window.send(encode({"type": "FileTransferPart", "part_index": index, "content": content} | source))


def malformed(upload_button: str) -> list[bytes | str]:
    """Return messages that viser cannot decode, and some for which no control exists."""
    update = {"type": "GuiUpdateMessage", "uuid": upload_button}
    return [
        os.urandom(1000),
        "text",
        b"",
        b"\x91" * 100_000 + b"\xc0",
        *(encode(m) for m in ([1], {"a": 1}, {"type": "Nothing"}, {"type": [1]}, {"type": "FileTransferStartUpload"})),
        encode(CAMERA | {"wxyz": "\x1b[2J"}),
        encode(update | {"updates": {"no_such_property": 1}}),
        encode(update | {"updates": [1]}),
    ]


def send_all(client: Client, messages: list[bytes | str]) -> None:
    """Send each message to a server in a window of its own, which the server may close."""
    for message in messages:
        with contextlib.suppress(ConnectionClosed), client.window() as window:
            window.send(message)
            # later messages are taken after it, or the window closes
            client.works(window)


def stray(log: str) -> list[str]:
    """Return lines of a log that are not our own."""
    return [line for line in log.splitlines() if not line.startswith(("splatgraft: expected", "open this address"))]


def test_messages_that_no_page_sends_are_a_line_in_the_log(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with opened_page(tmp_path / "project.toml") as page:
        client = Client(page.context.guarded.port, TOKEN)
        with client.window() as window:
            for props in list(client.controls.values()):
                for value in (None, 1e308, float("nan"), 2**63 - 1, "no option", [], {}, [1, 2], b"x"):
                    client.set(window, props.get("label") or "Step", value)
        send_all(client, malformed(client.control("Upload a video or a scene")))
        with client.window() as window:
            client.works(window)
    printed = capfd.readouterr()
    assert printed.out == ""
    assert not stray(printed.err)
    assert len(printed.err.splitlines()) > len(malformed(""))


# files that unpack to more than they hold


def lying_spz() -> bytes:
    """Return a .spz whose header gives 10 Gaussians, followed by half a gigabyte."""
    deflate = zlib.compressobj(9, zlib.DEFLATED, 31)
    head = struct.pack("<IIIBBBB", 0x5053474E, 2, 10, 0, 12, 0, 0)
    return deflate.compress(head) + b"".join(deflate.compress(bytes(1 << 20)) for _ in range(512)) + deflate.flush()


def deflated(path: Path, name: str, megabytes: int, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return a zip with one file of blanks."""
    with zipfile.ZipFile(path, "w", method) as archive, archive.open(name, "w") as stream:
        for _ in range(megabytes):
            stream.write(b" " * (1 << 20))
    return path.read_bytes()


def huge_png() -> bytes:
    """Return a picture of 60,000 x 60,000 pixels by its header."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")


def peak_mb(process: int) -> float:
    found = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{process}/status").read_text())
    assert found is not None
    return int(found[1]) / 1000


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="measures memory by /proc")
def test_attacks_of_all_kinds_leave_a_page_that_works(tmp_path: Path) -> None:
    project = tmp_path / "project" / "project.toml"
    project.parent.mkdir()
    (project.parent / "secret.toml").touch()
    editor = Editor(project, "--keep-closed")
    try:
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=(.*)", editor.url)
        assert found is not None
        client = Client(int(found[1]), found[2])
        with client.window() as window:
            client.works(window)
        before = peak_mb(editor.process.pid)
        foreign_requests(client)
        too_much(client)
        bad_files(client, tmp_path)
        with client.window() as window:
            client.works(window)
        # attacks of 100 MB and of half a gigabyte: room for the largest upload here, 50 parts, whole and in its parts
        assert peak_mb(editor.process.pid) < before + 150
        assert editor.end() == 0
    finally:
        if editor.process.poll() is None:
            editor.kill()
    assert not stray(editor.log.read_text())


def closing(window: ClientConnection) -> Close:
    """Read until the server closes a window, and return the close."""
    with contextlib.suppress(ConnectionClosed):
        while True:
            window.recv()
    assert window.close_code is not None
    return Close(window.close_code, window.close_reason or "")


def foreign_requests(client: Client) -> None:
    assert client.get("/", Cookie="") == 403
    assert client.get("/?token=guess", Cookie="") == 403
    assert client.get("/", Host="evil.example") == 403
    assert client.get("/", Origin="http://evil.example") == 403
    for wrong in ({"cookie": ""}, {"origin": "http://evil.example"}, {"protocol": "viser-v0.0.0"}):
        with pytest.raises(InvalidStatus):
            client.connect(**wrong)
    outside = ("../secret.toml", "%2e%2e/secret.toml", "/etc/passwd", "%2Fetc%2Fpasswd", "export/..%2f..%2fsecret.toml")
    for path in (*outside, "..\\secret.toml", "%00", "%ff", "a" * 5000):
        for prefix in ("/", "/files/", "/files/export/"):
            assert client.get(prefix + path) == 404, prefix + path
    assert client.get("/") == 200


def too_much(client: Client) -> None:
    with client.window() as window:
        with contextlib.suppress(ConnectionClosed):  # before all is sent
            window.send(bytes(100_000_000))
        assert closing(window).code == CloseCode.MESSAGE_TOO_BIG
    send_all(client, malformed(client.control("Upload a video or a scene")))
    with client.window() as window:
        # an upload announced as too large gives a message, and no part of it is kept
        client.upload(window, "big.ply", bytes(50 * PART), size=2 << 30)
        client.wait(window, lambda: any("at most 1 GiB" in text for text in client.said), what="the limit")
        client.upload(window, "more.ply", bytes(50 * PART), size=PART)
        many = []
        for _ in range(200):
            with contextlib.suppress(OSError):
                many.append(client.connect())
        # the first windows continue, and those above the limit get a message
        client.works(window)
        assert "at most 16 windows" in closing(many[-1]).reason
        for one in many:
            one.close()
    wait_until(lambda: client.get("/") == 200, what="the page after 200 connections")


def bad_files(client: Client, folder: Path) -> None:
    noise = os.urandom(1 << 20)
    bombs = {
        f"noise{suffix}": noise for suffix in (".ply", ".spz", ".sog", ".splat", ".glb", ".ksplat", ".mp4", ".zip")
    }
    bombs |= {
        "gzip.spz": lying_spz(),
        "meta.sog": deflated(folder / "meta.zip", "meta.json", 512),
        "bzip.sog": deflated(folder / "bzip.zip", "meta.json", 512, zipfile.ZIP_BZIP2),
        "photos.zip": deflated(folder / "photos.zip", "photo.jpg", 512),
    }
    with client.window() as window:
        for name, data in bombs.items():
            client.said.clear()
            client.upload(window, name, data)
            stored = folder / "project" / "uploads" / name
            client.wait(window, lambda name=name: any(f"{name}: stored as" in text for text in client.said), what=name)
            # the upload may have written its path into the field
            client.works(window)
            client.finds(window, str(stored), f"{name}: expected")
        photos = folder / "photos"
        photos.mkdir()
        for index in range(8):
            (photos / f"{index}.png").write_bytes(huge_png())
        (photos / "transforms.json").write_text(
            json.dumps(
                {"fl_x": 9, "frames": [{"file_path": f"{i}.png", "transform_matrix": IDENTITY} for i in range(8)]}
            )
        )
        client.finds(window, str(photos), "expected")
