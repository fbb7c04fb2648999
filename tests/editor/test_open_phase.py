"""The phase Open: the kind of a path before any work, and the views of scenes."""

import shutil
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from editor_pages import Client, opened_editor
from tiny_project import ball, photograph, plane

from splatgraft.folders.input_description import describe_input
from splatgraft.formats import write_gaussians
from splatgraft.project.toml_edit import with_keys


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("inputs")
    photograph(root / "posed", plane((0.3, 0.5, 0.3)), ball())
    write_gaussians(root / "ball.ply", ball())
    (root / "photos").mkdir()
    (root / "one").mkdir()
    (root / "empty").mkdir()
    for index in range(8):
        cv2.imwrite(str(root / "photos" / f"{index}.png"), np.full((20, 30, 3), 30 * index, np.uint8))
    cv2.imwrite(str(root / "one" / "0.png"), np.zeros((20, 30, 3), np.uint8))
    writer = cv2.VideoWriter(str(root / "walk.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for level in range(20):
        writer.write(np.full((48, 64, 3), 10 * level, np.uint8))
    writer.release()
    (root / "letter.pdf").write_bytes(b"%PDF-1.4 no capture")
    (root / "broken.ply").write_bytes(b"ply\nnonsense")
    shutil.copytree(root / "photos", root / "card" / "DCIM" / "100APPLE")
    (root / "card" / "MISC").mkdir()
    shutil.make_archive(str(root / "phone"), "zip", root / "card")
    for name in ("monday", "tuesday"):
        shutil.copytree(root / "photos", root / "days" / name)
    (root / "damaged.zip").write_bytes((root / "phone.zip").read_bytes()[:500])
    with zipfile.ZipFile(root / "outside.zip", "w") as archive:
        archive.writestr("../../evil.png", b"")
    with zipfile.ZipFile(root / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for index in range(9):
            archive.writestr(f"{index}.png", bytes(40 << 20))
    (root / "results").mkdir()
    write_gaussians(root / "results" / "scene.ply", ball())
    return root


@pytest.mark.parametrize(
    ("name", "kind", "text"),
    [
        ("ball.ply", "scene", "a trained scene of 80 Gaussians"),
        ("posed", "posed capture", "a capture of 8 images with poses, 8 of 8 photos have masks"),
        ("photos", "photos", "8 photos, no masks"),
        ("walk.avi", "video", "a video of 2 s, 64 x 48"),
        ("one", "nothing", "expected at least 8 photos, found 1"),
        ("empty", "nothing", "found an empty folder"),
        ("letter.pdf", "nothing", "expected a video that OpenCV can read"),
        ("broken.ply", "nothing", "broken.ply"),
        ("nowhere", "nothing", "found nothing there"),
        ("fotos", "nothing", "did you mean {inputs}/photos?"),
        ("photos/0.png", "nothing", "found a single photo"),
        ("card", "photos", "8 photos, no masks"),
        ("phone.zip", "photos", "8 photos, unpacked first"),
        ("days", "nothing", "monday/ (8 photos), tuesday/ (8 photos): name one of these"),
        ("damaged.zip", "nothing", "one that cannot be read"),
        ("outside.zip", "nothing", "one that writes outside of its folder"),
        ("bomb.zip", "nothing", "one that unpacks to 9 files of 0.4 GB"),
        ("results", "nothing", "name the scene in it"),
    ],
)
def test_what_a_path_is(inputs: Path, name: str, kind: str, text: str) -> None:
    before = sorted(inputs.rglob("*"))
    found = describe_input(inputs / name)
    assert found.kind == kind, found.text
    assert text.format(inputs=inputs) in found.text
    assert "\n" not in found.text
    assert found.is_usable == (kind != "nothing")
    assert sorted(inputs.rglob("*")) == before


def test_a_project_is_named_with_the_command_that_opens_it(project: Path) -> None:
    for path in (project, project.parent):
        found = describe_input(path)
        assert found.kind == "project"
        assert f"splatgraft edit {project.parent}" in found.text
        assert not found.is_usable


def test_a_project_is_started_only_of_two_usable_paths_which_a_list_of_folders_gives(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "home", lambda: inputs)
    with opened_editor(tmp_path / "new" / "project.toml") as editor, Client(editor.server.port).window() as window:
        assert window.control("start")["disabled"]
        window.do("source", str(inputs / "ball.ply"))
        window.says("80 Gaussians")
        window.do("target", str(inputs / "letter.pdf"))
        window.says("expected a video that OpenCV can read")
        assert window.control("start")["disabled"]
        # the field gives the folder at which the list begins
        window.send("do", id="browse_target")
        window.wait(lambda: window.has("entries"), what="the list of folders")
        assert {"photos/", "ball.ply", "walk.avi"} <= set(window.control("entries")["options"])
        assert "letter.pdf" not in window.control("entries")["options"]
        window.do("entries", "../../etc/passwd")
        window.do("entries", "photos/")
        window.says("8 photos are in this folder")
        window.do("use_folder")
        window.says("8 photos, no masks")
        window.wait(lambda: not window.control("start").get("disabled"), what="the start")
        # photos that are dropped are a folder of their own
        number, photo = window.panel["window"], (inputs / "photos" / "0.png").read_bytes()
        for index in range(8):
            address = f"/upload?window={number}&name=photos_7/{index}.png&use=upload_target"
            assert window.request("POST", address, photo + bytes([index]))[0] == 200
        uploaded = str(tmp_path / "new" / "uploads" / "photos_7")
        window.wait(lambda: window.control("target")["value"] == uploaded, what="the folder of the photos")


def test_an_opened_project_shows_how_its_scenes_are_viewed(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = with_keys(project.read_text(), "source", {"up": [0.0, -1.0, 0.0], "look": "within"})
    text = with_keys(text, "relight", {"light": "off"})
    project.write_text(with_keys(text, "target", {"up": [0.0, 0.25, 1.0]}))
    with opened_editor(project) as editor, Client(editor.server.port).window() as window:
        session = editor.require_session()
        monkeypatch.setattr(editor, "run", lambda to, title: None)
        window.step("Open")
        assert (window.control("look_source")["value"], window.control("up_source")["value"]) == ("from within", "-y")
        assert (window.control("look_target")["value"], window.control("up_target")["value"]) == (
            "from around",
            "(0, 0.25, 1)",
        )
        # one of them is changed: the other one stays
        window.do("look_target", "from within")
        window.wait(lambda: window.control("look_target")["value"] == "from within", what="the other look")
        source, target = (session.files.captures[side].look for side in ("source", "target"))
        assert (target.up, target.look) == ((0.0, 0.25, 1.0), "within")
        window.do("up_target", "as found")
        window.wait(lambda: window.control("up_target")["value"] == "as found", what="the other up")
        source, target = (session.files.captures[side].look for side in ("source", "target"))
        assert (target.up, target.look) == (None, "within")
        assert (source.up, source.look) == ((0.0, -1.0, 0.0), "within")
