"""The whole story in a browser, from two folders of photographs to the exported scene, with kills in between."""

import hashlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from editor_driver import Editor, Window, state_of, wait_until, with_browser
from tiny_project import OPTIONS, ball, photograph, plane

from splatgraft.editor.jobs.jobs import Jobs
from splatgraft.formats import read_gaussians
from splatgraft.formats.placement import read_placement

SCENES = ("source/scene/scene.ply", "target/scene/scene.ply", "object/object.ply", "composite/scene.ply")
RELIT, RESULT = "relit/scene.ply", "result/scene.ply"
# a ball and a plane have no photographed surroundings worth an estimate, but the transfer must run on them
LIT = OPTIONS.replace('light = "gain"', 'light = "transfer"')


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with with_browser() as found:
        yield found


def object_at(project: Path) -> torch.Tensor:
    return read_placement(project.parent / "placement.json").objects[0].target_from_object.translation


@pytest.mark.timeout(600)
def test_the_whole_story(browser: Any, tmp_path: Path) -> None:
    photograph(tmp_path / "photos" / "source", plane((0.3, 0.5, 0.3)), ball())
    photograph(tmp_path / "photos" / "target", plane((0.5, 0.45, 0.6)), None)
    project = tmp_path / "project" / "project.toml"
    project.parent.mkdir()
    editor = Editor(project)
    try:
        window = Window.opened(browser, editor)
        start_project(window, tmp_path)
        window = leave_and_come_back(window, browser, editor)
        select(window, project)
        place(window, project)
        editor, window = killed_while_dragging(window, browser, editor, project)
        light(window, project)
        editor, window = killed_while_running(window, browser, editor, project)
        export(window, project, tmp_path)
        assert editor.end() == 0
    finally:
        if editor.process.poll() is None:
            editor.kill()


def start_project(window: Window, root: Path) -> None:
    window.write("Object from", str(root / "photos" / "nowhere"))
    window.write("Place into", str(root / "photos" / "target"))
    window.click("Start the project")
    window.says("expected photos, a video, a posed capture or a scene, found nothing")
    window.write("Object from", str(root / "photos" / "source"))
    window.click("Start the project")
    window.says("the project is there")
    project = root / "project" / "project.toml"
    # what is written by hand while the editor runs is taken over
    project.write_text(project.read_text() + LIT)
    window.says("changed outside the editor")


def leave_and_come_back(window: Window, browser: Any, editor: Editor) -> Window:
    window.click("Reconstruct both scenes")
    window.page.wait_for_selector(".sg-job", timeout=30_000)
    window.page.close()
    window = Window.opened(browser, editor)
    window.quiet()
    window.says("400 Gaussians")
    return window


def select(window: Window, project: Path) -> None:
    window.turn("Select")
    window.check("Box around the object")
    wait_until(lambda: state_of(project).box is not None, timeout=20, what="a box in project.toml")
    window.says("are inside the box")
    window.click("Cut out the object")
    window.says("Cut out the object: done")
    window.says("are the object")
    before = len(read_gaussians(project.parent / "object" / "object.ply").means)
    window.choose("A stroke", "removes")
    # a rectangle over the upper left part of the picture, in the middle of the canvas
    window.page.keyboard.down("Shift")
    window.page.wait_for_timeout(150)
    window.drag((640, 300), (60, 400))
    window.page.keyboard.up("Shift")
    wait_until(lambda: state_of(project).corrections is not None, timeout=20, what="strokes")
    window.click("Undo")
    wait_until(lambda: state_of(project).corrections is None, timeout=20, what="the stroke undone")
    window.click("Redo")
    wait_until(lambda: state_of(project).corrections is not None, timeout=20, what="the stroke again")
    # the ball is in the middle between the two panels
    window.check("Brush")
    window.says("the brush is on")
    # the page hears of it a moment after its text
    window.page.wait_for_timeout(500)
    window.page.mouse.click(648, 450)
    window.says("Gaussians under the stroke")
    window.check("Brush")
    window.click("Undo")
    window.says("undone")
    window.click("Cut out the object")
    window.page.wait_for_selector(".sg-job", timeout=30_000)
    window.quiet()
    after = len(read_gaussians(project.parent / "object" / "object.ply").means)
    assert 0 < after < before


def place(window: Window, project: Path) -> None:
    window.turn("Place")
    window.click("Find a place for it")
    wait_until((project.parent / "placement.json").is_file, timeout=30, what="a placement")
    found = object_at(project)
    window.write("Scale", "0.5")
    wait_until(
        lambda: abs(read_placement(project.parent / "placement.json").objects[0].target_from_object.scale - 0.5) < 1e-6,
        timeout=20,
        what="the typed scale",
    )
    window.click("Undo")
    wait_until(lambda: torch.equal(object_at(project), found), timeout=20, what="the place before")
    window.click("Drop")
    window.says("dropped")
    window.click("Duplicate")
    wait_until(lambda: len(state_of(project).objects or ()) == 2, timeout=20, what="two objects")
    window.page.keyboard.press("Control+z")
    wait_until(lambda: len(state_of(project).objects or ()) == 1, timeout=20, what="one object again")
    window.page.wait_for_function(
        "() => [...document.querySelectorAll('.sg-caption')].some(e => e.textContent.includes('Light transfer'))",
        timeout=60_000,
    )


def killed_while_dragging(window: Window, browser: Any, editor: Editor, project: Path) -> tuple[Editor, Window]:
    before = object_at(project)
    at = window.handle_of_the_gizmo()
    window.drag(at, (0, -60), release=False)
    wait_until(lambda: not torch.equal(object_at(project), before), timeout=20, what="the drag in placement.json")
    editor.kill()
    window.page.mouse.up()
    window.page.close()
    moved = object_at(project)
    # along the object's own vertical, which is the ground's: a plane of noisy Gaussians, level to two degrees
    assert float(moved[2] - before[2]) > 0.01
    assert float((moved - before)[:2].norm()) < 0.035 * float(moved[2] - before[2])
    editor = Editor(project)
    window = Window.opened(browser, editor)
    window.turn("Place")
    window.click("Drop")
    wait_until(lambda: float(object_at(project)[2]) < float(moved[2]), timeout=20, what="the drop")
    return editor, window


def light(window: Window, project: Path) -> None:
    window.turn("Light")
    window.write("Shadow", "0.5")
    wait_until(lambda: state_of(project).weights.shadow == 0.5, timeout=20, what="the shadow's strength")


def killed_while_running(window: Window, browser: Any, editor: Editor, project: Path) -> tuple[Editor, Window]:
    jobs = Jobs(project.parent / ".editor")
    window.turn("Run")
    window.click("Harmonise and consolidate")
    wait_until(lambda: (state := jobs.state()) is not None and state.live, timeout=30, what="the job")
    editor.kill()
    window.page.close()
    editor = Editor(project)
    window = Window.opened(browser, editor)
    wait_until(lambda: (state := jobs.state()) is not None and state.outcome == "done", timeout=120, what="the end")
    assert (project.parent / "result" / "scene.ply").is_file()
    window.turn("Run")
    window.click("Make the report too")
    window.says("Make the report: done", timeout=90)
    return editor, window


def first_difference(one: Path, other: Path) -> str:
    """The first scene, in the order in which they are made, that two runs of one project disagree on."""
    for name in (*SCENES, RELIT, RESULT):
        files = [folder / name for folder in (one, other)]
        assert [file.is_file() for file in files] in ([True, True], [False, False]), name
        if not files[0].is_file() or files[0].read_bytes() == files[1].read_bytes():
            continue
        first, second = (read_gaussians(file) for file in files)
        if first.count != second.count:
            return f"{name}: {first.count} and {second.count} Gaussians"
        apart = {key: float((getattr(first, key) - getattr(second, key)).abs().max()) for key in ("means", "sh")}
        rows = ((first.sh - second.sh).flatten(1).abs().max(1).values > 0).nonzero()[:, 0].tolist()
        return f"{name}: apart by {apart}, colours of {len(rows)} Gaussians, {rows[:5]}"
    return ""


def export(window: Window, project: Path, root: Path) -> None:
    with window.page.expect_download() as download:
        window.click(".ply")
    clicked = Path(download.value.path()).read_bytes()
    # the same decisions, by commands alone, in another place
    again = root / "again" / "project.toml"
    again.parent.mkdir()
    for name in ("project.toml", "placement.json", "corrections.npy"):
        shutil.copy(project.parent / name, again.parent / name)
    placement = again.parent / "placement.json"
    assert str(root) not in placement.read_text()
    # as a person would: a process of its own
    words = [sys.executable, "-m", "splatgraft", "run", str(again), "--to", "consolidate"]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, timeout=200)
    assert not first_difference(project.parent, again.parent)
    digests = [hashlib.sha256(content).hexdigest() for content in (clicked, (again.parent / RESULT).read_bytes())]
    assert digests[0] == digests[1]
    with window.page.expect_download() as download:
        window.click(".spz")
    assert read_gaussians(Path(shutil.copy(download.value.path(), root / "taken.spz"))).count > 100
    report = window.page.request.get(window.page.url.rstrip("/") + "/files/index.html")
    assert report.ok
    assert "<html" in report.text()
    assert not window.page.request.get(window.page.url.rstrip("/") + "/files/../project.toml").ok
