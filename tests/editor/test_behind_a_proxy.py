"""The editor under a path of a host, behind a reverse proxy, and with a certificate of its own."""

import shutil
import ssl
import subprocess
from pathlib import Path

import pytest
from editor_driver import Editor
from front_requests import PROJECT, answer, cookie_of, opened, websocket
from reverse_proxy import ProxyRules, reverse_proxy
from tiny_project import ball, plane
from upload_requests import ChosenFile, Upload

from splatgraft.cli import main
from splatgraft.editor.access.tls import read_certificate
from splatgraft.formats import write_gaussians

PORT = 18190
RULES = [ProxyRules("/splat", *choices) for choices in ((True, False), (True, True), (False, True))]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("proxied") / "work"
    for name in ("one", "two"):
        (root / name).mkdir(parents=True)
        (root / name / "project.toml").write_text(PROJECT)
    write_gaussians(root / "source.ply", ball())
    write_gaussians(root / "target.ply", plane((0.5, 0.5, 0.5)))
    return root


@pytest.mark.parametrize("rules", RULES, ids=["stripped", "stripped, host kept", "path kept"])
def test_all_pages_are_reached_under_a_path(folder: Path, rules: ProxyRules) -> None:
    editor = Editor(folder, "--public-url", f"http://127.0.0.1:{PORT}/splat/", "--port", "18181")
    base = f"http://127.0.0.1:{PORT}"
    try:
        assert editor.url.startswith(f"{base}/splat/?token=")
        with reverse_proxy(rules, ["127.0.0.1:18181"], PORT):
            assert answer(f"{base}/splat/")[0] == 403
            status, headers, page = answer(editor.url)
            assert status == 200
            assert '<base href="/splat/">' in page.decode()
            assert headers["Set-Cookie"].endswith("; Path=/splat")
            cookie = headers["Set-Cookie"].partition(";")[0]
            assert answer(f"{base}/splat/start_page.css", Cookie=cookie)[0] == 200
            assert "<title>Viser</title>" in opened(f"{base}/splat/p/one", cookie)
            assert websocket(f"{base}/splat/p/one", base, cookie)[0] == 101
            assert websocket(f"{base}/splat/p/one", base)[0] == 403
            assert answer(f"{base}/splat/p/one/upload_form.js", Cookie=cookie)[0] == 200
            upload = Upload(f"{base}/splat/p/one/?token={editor.token}", "no key", ChosenFile(b"x"))
            assert upload.answer == {"type": "wait", "text": "the page is being loaded"}
            assert websocket(f"{base}/splat/p/one/upload", base)[0] == 403
            for origin in ("http://127.0.0.1:1", "https://elsewhere.example", f"https://127.0.0.1:{PORT}"):
                assert websocket(f"{base}/splat/p/one", origin, cookie)[0] == 403
                assert answer(f"{base}/splat/list", Cookie=cookie, Origin=origin)[0] == 403
    finally:
        editor.end()


def test_one_project_is_reached_under_a_path(folder: Path) -> None:
    editor = Editor(folder / "one", "--public-url", f"http://127.0.0.1:{PORT}/splat", "--port", "18181")
    try:
        with reverse_proxy(RULES[0], ["127.0.0.1:18181"], PORT):
            base = f"http://127.0.0.1:{PORT}"
            status, headers, _ = answer(editor.url, follow=False)
            assert (status, headers["Location"]) == (302, f"/splat/p/one/?token={editor.token}")
            cookie = headers["Set-Cookie"].partition(";")[0]
            assert "<title>Viser</title>" in opened(f"{base}/splat/", cookie)
            # viser's page takes its own address without the last slash
            assert websocket(f"{base}/splat/p/one", base, cookie)[0] == 101
    finally:
        editor.end()


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    if shutil.which("openssl") is None:
        pytest.skip("no openssl, which makes a certificate")
    folder = tmp_path_factory.mktemp("tls")
    return make_certificate(folder, "a")


def make_certificate(folder: Path, name: str, *options: str) -> tuple[Path, Path]:
    certificate, key = folder / f"{name}.pem", folder / f"{name}.key"
    words = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-days", "2", "-subj", "/CN=127.0.0.1"]
    words += ["-addext", "subjectAltName=IP:127.0.0.1", "-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*words, *(options or ["-noenc"])], check=True, capture_output=True)
    return certificate, key


def test_https_and_encrypted_websockets(folder: Path, certificate: tuple[Path, Path]) -> None:
    words = ("--tls-certificate", str(certificate[0]), "--tls-key", str(certificate[1]), "--port", "18182")
    editor = Editor(folder, *words)
    context = ssl.create_default_context(cafile=str(certificate[0]))
    try:
        assert editor.base.startswith("https://127.0.0.1:")
        assert answer(editor.base, context)[0] == 403
        assert answer(editor.url, context)[1]["Set-Cookie"].endswith("; Path=/; Secure")
        cookie = cookie_of(editor, context=context)
        assert "<title>Viser</title>" in opened(f"{editor.base}/p/one/", cookie, context)
        status, first = websocket(f"{editor.base}/p/one", editor.base, cookie, context)
        assert (status, len(first) > 100) == (101, True)
        assert websocket(f"{editor.base}/p/one", editor.base, "", context)[0] == 403
        upload = Upload(f"{editor.base}/p/one/?token={editor.token}", "no key", ChosenFile(b"x"), context=context)
        assert upload.answer["type"] == "wait"
        assert websocket(f"{editor.base}/p/one/upload", editor.base, "", context)[0] == 403
        # an unencrypted request is not answered
        with pytest.raises((OSError, ValueError)):
            answer(editor.base.replace("https", "http"))
        with pytest.raises(OSError, match="CERTIFICATE_VERIFY_FAILED"):
            answer(editor.base, ssl.create_default_context())
        assert answer(f"{editor.base}/list", context, Cookie=cookie)[0] == 200
    finally:
        editor.end()


def test_bad_certificates_are_one_line_each(
    certificate: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own, key = certificate
    other = make_certificate(tmp_path, "other")[1]
    locked = make_certificate(tmp_path, "locked", "-passout", "pass:word")[1]
    (tmp_path / "cut.pem").write_text(own.read_text()[:300] + "\n-----END CERTIFICATE-----\n")
    (tmp_path / "binary.pem").write_bytes(b"\x30\x82\x00\xff")
    cases = [
        (tmp_path / "nowhere.pem", key, f"{tmp_path}/nowhere.pem: expected a readable file, found No such file"),
        (tmp_path, key, f"{tmp_path}: expected a readable file, found Is a directory"),
        (key, own, f"{key}: expected a PEM file with a certificate, found none in it"),
        (tmp_path / "binary.pem", key, "binary.pem: expected a PEM file with a certificate, found none in it"),
        (own, own, f"{own}: expected a PEM file with a private key, found none in it"),
        (own, other, f"{other}: expected the private key of {own}, found another key"),
        (own, locked, "--tls-key: expected a key without a password, found an encrypted one"),
        (tmp_path / "cut.pem", key, f"{tmp_path}/cut.pem: expected a certificate that can be read, found"),
    ]
    for given, given_key, line in cases:
        words = ["edit", str(tmp_path), "--tls-certificate", str(given), "--tls-key", str(given_key)]
        assert main(words) == 2
        printed = capsys.readouterr()
        assert line in printed.err
        assert len(printed.err.splitlines()) == 1
        assert printed.out == ""
    assert read_certificate(None, None) is None
