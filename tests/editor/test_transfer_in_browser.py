"""A transfer in the browser, from two folders of photographs to the exported scene; the server is killed in between."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch
from editor_driver import Editor, Window, history_of, jobs_of, state_of, wait_for_job
from tiny_project import OPTIONS, ball, photograph, plane
from waiting import HANG_LIMIT

from splatgraft.formats import read_gaussians
from splatgraft.formats.placement import read_placement

SCENES = ("source/scene/scene.ply", "target/scene/scene.ply", "object/object.ply", "composite/scene.ply")
RELIT, RESULT = "relit/scene.ply", "result/scene.ply"
# a ball and a plane give little evidence of the light, but the transfer must run on them
LIT = OPTIONS.replace('light = "gain"', 'light = "transfer"')


def object_at(project: Path) -> torch.Tensor:
    return read_placement(project.parent / "placement.json").objects[0].target_from_object.translation


def test_a_transfer_from_photographs_to_the_exported_scene(browser: Any, tmp_path: Path) -> None:
    photograph(tmp_path / "photos" / "source", plane((0.3, 0.5, 0.3)), ball())
    photograph(tmp_path / "photos" / "target", plane((0.5, 0.45, 0.6)), None)
    project = tmp_path / "project" / "project.toml"
    project.parent.mkdir()
    editor = Editor(project)
    try:
        window = Window.opened(browser, editor)
        start_project(window, tmp_path)
        window = close_the_window_during_a_job(window, browser, editor, project)
        select(window, project)
        place(window, project)
        editor, window = kill_the_editor_during_a_drag(window, browser, editor, project)
        light(window, project)
        editor, window = kill_the_editor_during_a_job(window, browser, editor, project)
        export(window, project, tmp_path)
        assert editor.end() == 0
    finally:
        if editor.process.poll() is None:
            editor.kill()


def start_project(window: Window, root: Path) -> None:
    window.write("Object from", str(root / "photos" / "nowhere"))
    window.write("Place into", str(root / "photos" / "target"))
    # it says what a path is before anything is made of it
    window.says("expected a file or a folder, found nothing there")
    assert window.page.get_by_role("button", name="Start the project").is_disabled()
    window.write("Object from", str(root / "photos" / "source"))
    window.says("a capture of 8 images with poses")
    window.click("Start the project")
    window.says("the project was created")
    project = root / "project" / "project.toml"
    # changes by hand while the editor runs are loaded
    project.write_text(project.read_text() + LIT)
    window.says("changed outside the editor")


def close_the_window_during_a_job(window: Window, browser: Any, editor: Editor, project: Path) -> Window:
    window.start_job(project, "Reconstruct both scenes")
    window.page.close()
    window = Window.opened(browser, editor)
    state = jobs_of(project).state
    window.until(lambda: window.shows_job() or not ((job := state()) and job.live), what="the job on the page")
    window.finish_job(project)
    window.says("400 Gaussians")
    return window


def select(window: Window, project: Path) -> None:
    window.show_phase("Select")
    window.check("Box around the object")
    window.until(lambda: state_of(project).box is not None, what="a box in project.toml")
    window.says("are inside the box")
    window.start_job(project, "Cut out the object")
    window.says("Cut out the object: done")
    window.says("are the object")
    before = len(read_gaussians(project.parent / "object" / "object.ply").means)
    window.choose("Strokes", "remove")

    def drag_a_rectangle() -> None:
        # over the upper left part of the image, in the middle of the canvas
        window.page.keyboard.down("Shift")
        window.drag((450, 300), (60, 400))
        window.page.keyboard.up("Shift")

    window.act_until(drag_a_rectangle, lambda: state_of(project).corrections is not None, what="corrections")
    window.undo_until(project, lambda: state_of(project).corrections is None)
    window.click("Redo")

    def is_redone() -> bool:
        # the history is written after the files of the state, and only then names it
        return state_of(project).corrections is not None and not history_of(project)["future"]

    window.until(is_redone, what="the corrections again")
    selected = history_of(project)["present"]
    window.check("Brush")
    window.says("the brush is on")
    # the ball is in the middle of the canvas
    stroke = "Gaussians under the stroke"
    window.act_until(lambda: window.page.mouse.click(470, 450), lambda: window.shows(stroke), what="a brush stroke")
    window.check("Brush", False)
    window.says("the brush is off")
    window.undo_until(project, lambda: history_of(project)["present"] == selected)
    window.start_job(project, "Cut out the object")
    window.finish_job(project)
    after = len(read_gaussians(project.parent / "object" / "object.ply").means)
    assert 0 < after < before


def place(window: Window, project: Path) -> None:
    window.show_phase("Place")
    window.click("Find a place")
    window.until((project.parent / "placement.json").is_file, what="a placement")
    found = object_at(project)

    def scale() -> float:
        return read_placement(project.parent / "placement.json").objects[0].target_from_object.scale

    window.write("Scale", "0.5", effect=lambda: abs(scale() - 0.5) < 1e-6)
    window.undo_until(project, lambda: torch.equal(object_at(project), found) and abs(scale() - 0.5) > 1e-6)
    window.click("Drop")
    window.says("dropped")
    window.click("Duplicate")
    window.until(lambda: len(state_of(project).objects or ()) == 2, what="two objects")
    window.page.keyboard.press("Control+z")
    window.until(lambda: len(state_of(project).objects or ()) == 1, what="one object again")
    window.until(lambda: "Light transfer" in window.caption(), what="a preview of the light transfer")


def kill_the_editor_during_a_drag(window: Window, browser: Any, editor: Editor, project: Path) -> tuple[Editor, Window]:
    before = object_at(project)
    window.drag_gizmo((0, -60), lambda: not torch.equal(object_at(project), before), what="a drag in placement.json")
    editor.kill()
    window.page.mouse.up()
    window.page.close()
    moved = object_at(project)
    # along the object's own vertical, which is the ground's: a plane of noisy Gaussians, level to two degrees
    assert float(moved[2] - before[2]) > 0.01
    assert float((moved - before)[:2].norm()) < 0.035 * float(moved[2] - before[2])
    editor = Editor(project)
    window = Window.opened(browser, editor)
    window.show_phase("Place")
    window.click("Drop")
    window.until(lambda: float(object_at(project)[2]) < float(moved[2]), what="the drop")
    return editor, window


def light(window: Window, project: Path) -> None:
    window.show_phase("Light")
    window.write("Shadow", "0.5", effect=lambda: state_of(project).weights.shadow == 0.5)


def kill_the_editor_during_a_job(window: Window, browser: Any, editor: Editor, project: Path) -> tuple[Editor, Window]:
    window.show_phase("Run")
    window.start_job(project, "Harmonise and consolidate")
    editor.kill()
    window.page.close()
    editor = Editor(project)
    window = Window.opened(browser, editor)
    wait_for_job(project)
    assert (project.parent / "result" / "scene.ply").is_file()
    window.show_phase("Run")
    window.start_job(project, "Make the report")
    window.says("Make the report: done")
    return editor, window


def first_difference(one: Path, other: Path) -> str:
    """Describe the first scene, in the order of the flow, that differs between two runs; empty where none does."""
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


def share(window: Window, kind: str) -> bytes:
    """Choose a kind of file, and take the file that the browser gets once the job has written it."""
    window.choose("As", kind)
    return window.download("Write and download").read_bytes()


def export(window: Window, project: Path, root: Path) -> None:
    clicked = share(window, "Scene, exact (.ply)")
    window.says(" MB in ")
    # the same edits in another folder, run by commands
    again = root / "again" / "project.toml"
    again.parent.mkdir()
    for name in ("project.toml", "placement.json", "corrections.npy"):
        shutil.copy(project.parent / name, again.parent / name)
    placement = again.parent / "placement.json"
    assert str(root) not in placement.read_text()
    words = [sys.executable, "-m", "splatgraft", "run", str(again), "--to", "consolidate"]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, timeout=HANG_LIMIT)
    assert not first_difference(project.parent, again.parent)
    words = [sys.executable, "-m", "splatgraft", "export", str(again), "--to", str(root / "again.ply")]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, timeout=HANG_LIMIT)
    assert clicked == (root / "again.ply").read_bytes()
    (root / "taken.sog").write_bytes(share(window, "Scene, small (.sog)"))
    assert read_gaussians(root / "taken.sog").count > 100
    base = window.page.url.partition("?")[0].rstrip("/") + "/files/"
    served = {name: window.page.request.get(base + name) for name in ("index.html", "export/project.sog")}
    assert all(answer.ok for answer in served.values())
    assert "<html" in served["index.html"].text()
    assert served["export/project.sog"].body() == (root / "taken.sog").read_bytes()
    assert not window.page.request.get(base + "../project.toml").ok
    assert not window.page.request.get(base + "export/../project.toml").ok
