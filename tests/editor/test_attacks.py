"""Messages that no page sends are refused in one line and in bounded memory, and the page continues."""

import contextlib
import json
import os
import re
import shutil
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import pytest
from editor_pages import Client, opened_editor
from waiting import HANG_LIMIT, wait_until
from websockets.exceptions import ConnectionClosed, InvalidStatus

IDENTITY = [[float(row == column) for column in range(4)] for row in range(4)]


def malformed() -> list[bytes | str]:
    """Return messages that no page sends."""
    wrong = (
        {"t": "pointer", "what": "move", "x": 1e9, "y": 0},
        {"t": "size", "w": -1, "h": 1},
        {"t": "turn", "x": "a"},
    )
    return [
        os.urandom(1000),
        "text",
        b"",
        "[" * 30_000,
        '{"t": "turn", "x": NaN, "y": 0}',
        '{"t": "zoom", "by": 1e999}',
        *(json.dumps(m) for m in ([1], {"a": 1}, {"t": "nothing"}, {"t": [1]}, {"t": "__init__"}, 7, None, *wrong)),
    ]


def works(window: Client) -> None:
    """Assert that the page answers to this window."""
    window.step("Open")
    number = len(os.urandom(9)) + int.from_bytes(os.urandom(4), "little")
    window.do("source", f"nowhere_{number}")
    window.wait(lambda: f"nowhere_{number}: expected" in window.texts(), what="an answer")


def stray(log: str) -> list[str]:
    """Return lines of a log that are not our own."""
    return [line for line in log.splitlines() if not line.startswith(("splatgraft: expected", "open this address"))]


def test_messages_that_no_page_sends_are_a_line_in_the_log(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with opened_editor(tmp_path / "project.toml") as editor, Client(editor.server.port).window() as window:
        for one in list(window.panel["controls"]):
            for value in (None, 1e300, 2**63, "no option", [], {}, [1, 2], [[]]):
                window.send("do", id=one["id"], value=value)
                window.send("live", id=one["id"], value=value)
        for what in (
            {"t": "do"},
            {"t": "key"},
            {"t": "key", "key": 7},
            {"t": "pointer", "what": "down", "on": "object:x"},
        ):
            window.socket.send(json.dumps(what))
        for message in malformed():
            window.socket.send(message)
            works(window)
    printed = capfd.readouterr()
    assert printed.out == ""
    assert len([line for line in printed.err.splitlines() if line.startswith("splatgraft: expected")]) >= 10
    assert "Traceback" not in printed.err


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
    words = [sys.executable, "-m", "splatgraft", "edit", str(project), "--port", "18080", "--keep-closed"]
    log = tmp_path / "server.log"
    with log.open("ab") as errors:
        process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=errors, text=True)
    try:
        assert process.stdout is not None
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=(.*)", process.stdout.readline().strip())
        assert found is not None, log.read_text()
        client = Client(int(found[1]), found[2])
        with client.window() as window:
            works(window)
        before = peak_mb(process.pid)
        foreign_requests(client)
        too_much(client, project.parent)
        bad_files(client, tmp_path)
        with client.window() as window:
            works(window)
        # attacks of 100 MB and of half a gigabyte; an upload goes to the disk
        assert peak_mb(process.pid) < before + 100
        process.terminate()
        assert process.wait(HANG_LIMIT) == 0
    finally:
        process.kill()
        process.communicate()  # closes the pipe
    assert not stray(log.read_text())


def foreign_requests(client: Client) -> None:
    assert client.get("/", Cookie="") == 403
    assert client.get("/?token=guess", Cookie="") == 403
    assert client.get("/", Host="evil.example") == 403
    assert client.get("/", Origin="http://evil.example") == 403
    assert client.request("POST", "/upload?window=1&name=a.ply&use=x", b"x", Origin="http://evil.example")[0] == 403
    for wrong in ({"cookie": ""}, {"origin": "http://evil.example"}):
        with pytest.raises(InvalidStatus):
            client.connect(**wrong)
    outside = ("../secret.toml", "%2e%2e/secret.toml", "/etc/passwd", "%2Fetc%2Fpasswd", "export/..%2f..%2fsecret.toml")
    for path in (*outside, "..%5csecret.toml", "%00", "%ff", "a" * 5000):
        for prefix in ("/", "/files/", "/files/export/"):
            assert client.get(prefix + path) == 404, prefix + path
    assert client.get("/") == 200


def too_much(client: Client, folder: Path) -> None:
    with client.window() as window:
        with contextlib.suppress(ConnectionClosed):  # before all is sent
            window.socket.send("a" * 100_000_000)
        # 1009 is lost where the connection ends before the client has sent all
        assert window.closed_with()[0] in (1006, 1009)
    with client.window() as window:
        for message in malformed():
            window.socket.send(message)
        works(window)
        number = window.panel["window"]
        address = f"/upload?window={number}&name=big.ply&use=upload_source"
        with contextlib.suppress(OSError):
            status, text = client.request("POST", address, b"x", **{"Content-Length": str(2 << 30)})
            assert (status, "at most 1 GiB" in text) == (413, True)
        assert not list((folder / "uploads").glob("big*"))
        many = []
        for _ in range(40):
            with contextlib.suppress(OSError):
                many.append(client.connect())
        # the first windows continue, and those above the limit get a message
        works(window)
        with contextlib.suppress(ConnectionClosed):
            while True:
                many[-1].recv()
        assert "at most 16 windows" in (many[-1].close_reason or "")
        for one in many:
            one.close()
    wait_until(lambda: client.get("/") == 200, what="the page after 40 connections")


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
            number = window.panel["window"]
            assert client.request("POST", f"/upload?window={number}&name={name}&use=upload_source", data)[0] == 200
            window.says(f"{name}: expected")
        photos = folder / "photos"
        photos.mkdir()
        for index in range(8):
            (photos / f"{index}.png").write_bytes(huge_png())
        frames = [{"file_path": f"{i}.png", "transform_matrix": IDENTITY} for i in range(8)]
        (photos / "transforms.json").write_text(json.dumps({"fl_x": 9, "frames": frames}))
        window.do("source", str(photos))
        window.wait(lambda: "60000" in window.texts() or "expected" in window.texts(), what="the refusal")
    shutil.rmtree(photos)
