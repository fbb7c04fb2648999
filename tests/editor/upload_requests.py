"""Uploads as the page's form makes them, with connections that a test may break."""

import json
import re
import secrets
import socket
import ssl
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from editor import Client
from waiting import HANG_LIMIT, wait_until
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

SAMPLE_BYTES = 64 << 10
PART = 100_000


@dataclass(frozen=True)
class ChosenFile:
    """A file as a browser would announce it."""

    content: bytes
    name: str = "ball.ply"
    modified: int = 1_700_000_000_000
    form: str = "upload-a-video-or-a-scene"
    attempt: str = field(default_factory=lambda: secrets.token_hex(8))
    announced: int | None = None
    """Size that is announced; None: the true one."""

    @property
    def sample(self) -> bytes:
        """The first and last bytes."""
        return self.content[:SAMPLE_BYTES] + self.content[-SAMPLE_BYTES:]


def opened_window(url: str) -> tuple[Client, str]:
    """A window on the page at the complete address, and its key."""
    window = Client(url)
    window.look(0.3)
    keys: list[str] = []

    def has_key() -> bool:
        # to the end of what has arrived: `Client.until` drops the rest of the messages that came together
        for _ in window.messages(0.1):
            pass
        contents = [str(props.get("content")) for props in window._gui.values()]
        keys.extend(re.findall(r'<splatgraft-window key="([^"]+)"', " ".join(contents)))
        return bool(keys)

    wait_until(has_key, what="the key of a window")
    return window, keys[-1]


class Upload:
    """One connection of an upload."""

    def __init__(
        self, url: str, key: str, file: ChosenFile, *, origin: str | None = None, context: ssl.SSLContext | None = None
    ) -> None:
        """Announce a file at the page's complete address; `answer` is the first answer."""
        base, _, query = url.partition("/?")
        self.file = file
        self.connection: ClientConnection = connect(
            f"{base.replace('http', 'ws', 1)}/upload?{query}",
            origin=origin or re.match(r"https?://[^/]+", base)[0],  # pyright: ignore
            open_timeout=HANG_LIMIT,
            ssl=context,
            proxy=None,
        )
        size = len(file.content) if file.announced is None else file.announced
        announced = {"name": file.name, "size": size, "modified": file.modified}
        self.send({"window": key, "form": file.form, "attempt": file.attempt, **announced})
        self.answer = self.hear()
        self.received = 0
        self.sent = 0
        """Bytes of parts that this connection has sent."""

    def send(self, message: dict[str, Any]) -> None:
        """Send a text message."""
        self.connection.send(json.dumps(message))

    def hear(self) -> dict[str, Any]:
        """The next message."""
        return json.loads(self.connection.recv(HANG_LIMIT))

    def begin(self) -> int:
        """Send the first and last bytes; gives the byte at which the upload starts, or -1 with another answer."""
        assert self.answer == {"type": "sample"}
        self.connection.send(self.file.sample)
        self.answer = self.hear()
        self.received = self.answer.get("at", -1)
        return self.received

    def send_parts(self, until: int | None = None) -> None:
        """Send parts up to a byte, each acknowledged before the next."""
        end = len(self.file.content) if until is None else until
        while self.received < end:
            part = self.file.content[self.received : min(end, self.received + PART)]
            self.connection.send(part)
            self.sent += len(part)
            self.answer = self.hear()
            assert self.answer["type"] == "received", self.answer
            assert self.answer["bytes"] == self.received + len(part)
            self.received += len(part)

    def end(self) -> dict[str, Any]:
        """The last message, after those that say that the file is being checked."""
        while True:
            self.answer = self.hear()
            if self.answer["type"] != "checking":
                return self.answer

    def close(self) -> None:
        """End the connection."""
        self.connection.close()

    def cut(self) -> None:
        """Break the connection as a lost network does: without a word to the server but a reset."""
        self.connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.connection.socket.shutdown(socket.SHUT_RDWR)
        try:
            self.connection.recv(HANG_LIMIT)
        except ConnectionClosed:
            return
        raise AssertionError("expected a broken connection")


def arriving(project: Path) -> list[Path]:
    """Files of what has arrived of interrupted uploads."""
    return sorted((project.parent / "uploads").glob(".incoming_*"))
