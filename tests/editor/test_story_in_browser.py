"""The whole way in the browser, from two scene files to the shared result; the server is killed in between."""

import shutil
from functools import partial
from pathlib import Path
from typing import Any

import torch
from editor_driver import Editor, Window, history_of, jobs_of, state_of, wait_for_job
from editor_pages import AROUND_THE_BALL
from tiny_project import ball, plane

from splatgraft.cli import main
from splatgraft.core.gaussians import concatenate
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.formats.placement import read_placement
from splatgraft.project.toml_edit import with_keys

RESULTS = ("object/object.ply", "composite/scene.ply", "relit/scene.ply", "result/scene.ply")


def object_at(project: Path) -> torch.Tensor:
    return read_placement(project.parent / "placement.json").objects[0].target_from_object.translation


def test_the_whole_way_from_scene_files_to_the_shared_result(browser: Any, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "source.ply", concatenate([plane((0.3, 0.5, 0.3)), ball()]))
    write_gaussians(tmp_path / "target.ply", plane((0.5, 0.45, 0.6)))
    project = tmp_path / "project" / "project.toml"
    project.parent.mkdir()
    editor = Editor(project)
    try:
        window = Window.opened(browser, editor.url)
        window = open_scenes(window, browser, editor, tmp_path)
        select(window, project)
        place(window, project)
        light(window, project)
        editor, window = kill_the_editor_during_a_job(window, browser, editor, project)
        share(window, project, tmp_path)
        assert editor.end() == 0
    finally:
        if editor.process.poll() is None:
            editor.kill()


def open_scenes(window: Window, browser: Any, editor: Editor, root: Path) -> Window:
    project = root / "project" / "project.toml"
    window.write("Object from", str(root / "nowhere"))
    window.upload("Upload a video or a scene", root / "target.ply")
    window.says("target.ply: stored as")
    # it says what a path is before anything is made of it
    window.says("expected a file or a folder, found nothing there")
    assert window.page.get_by_role("button", name="Start the project").is_disabled()
    window.write("Object from", str(root / "source.ply"))
    window.says("a trained scene of 224 Gaussians")
    # the job goes on while no window is open
    window.start_job(project, "Start the project")
    window.page.close()
    window = Window.opened(browser, editor.url)
    state = jobs_of(project).state
    window.until(lambda: window.shows_job() or not ((job := state()) and job.live), what="the job on the page")
    window.finish_job(project)
    window.says("224 Gaussians; without photographs")
    assert (project.parent / "target" / "scene" / "scene.ply").read_bytes() == (root / "target.ply").read_bytes()
    # changes by hand while the editor is open are loaded
    text = project.read_text()
    for table, keys in (("segment", {"solidify": 4}), ("consolidate", {"passes": 1})):
        text = with_keys(text, table, keys)
    project.write_text(text)
    window.says("changed outside the editor")
    return window


def select(window: Window, project: Path) -> None:
    window.show_phase("Select")
    window.choose("Masks from", "no masks: everything inside the box")
    window.check("Box around the object")
    window.until(lambda: state_of(project).box is not None, what="a box in project.toml")
    for label, first in (("Box to", 3), ("Box from", 0)):
        for index in range(3):
            wanted = AROUND_THE_BALL[first + index]

            def is_saved(at: int = first + index, wanted: float = wanted) -> bool:
                return (state_of(project).box or ())[at] == wanted

            window.write_number(label, index, wanted, effect=is_saved)
    window.choose("Keep pieces", "all")
    window.says("80 of 224 Gaussians are inside the box")
    window.start_job(project, "Cut out the object")
    window.says("Cut out the object: done")
    assert read_gaussians(project.parent / "object" / "object.ply").count == 80


def place(window: Window, project: Path) -> None:
    window.show_phase("Place")
    window.click("Find a place")
    window.until((project.parent / "placement.json").is_file, what="a placement")
    found = object_at(project)

    def scale() -> float:
        return read_placement(project.parent / "placement.json").objects[0].target_from_object.scale

    window.write("Scale", "0.5", effect=lambda: abs(scale() - 0.5) < 1e-6)
    window.undo_until(project, lambda: torch.equal(object_at(project), found) and abs(scale() - 0.5) > 1e-6)
    window.click("Duplicate")
    window.until(lambda: len(state_of(project).objects or ()) == 2, what="two objects")
    window.page.keyboard.press("Control+z")
    window.until(lambda: len(state_of(project).objects or ()) == 1, what="one object again")
    window.until(lambda: "Light transfer" in window.caption(), what="a preview of the light transfer")

    # by a number, as which handle a drag takes depends on the picture; test_page.py and the random actions drag
    height = float(window.inputs("Position").nth(2).input_value())
    window.write_number("Position", 2, height + 0.05, effect=lambda: float(object_at(project)[2] - found[2]) > 0.01)
    moved = object_at(project)
    window.click("Drop")
    window.until(lambda: float(object_at(project)[2]) < float(moved[2]), what="the drop")


def light(window: Window, project: Path) -> None:
    window.show_phase("Light")
    window.write("Shadow", "0.5", effect=lambda: state_of(project).weights.shadow == 0.5)


def kill_the_editor_during_a_job(window: Window, browser: Any, editor: Editor, project: Path) -> tuple[Editor, Window]:
    steps = len(history_of(project)["past"])
    window.show_phase("Run")
    window.start_job(project, "Harmonise and consolidate")
    # the page first: its failing attempts to connect again would delay those of the next one
    window.page.close()
    editor.kill()
    editor = Editor(project)
    window = Window.opened(browser, editor.url)
    wait_for_job(project)
    assert (project.parent / "result" / "scene.ply").is_file()
    # undo survives the kill
    window.show_phase("Light")
    window.undo_until(project, lambda: state_of(project).weights.shadow == 1.0)
    window.click("Redo")
    window.until(lambda: len(history_of(project)["past"]) == steps, what="the weight again")
    return editor, window


def share(window: Window, project: Path, root: Path) -> None:
    window.show_phase("Run")
    window.choose("As", "Scene, exact (.ply)")
    shared = window.download("Write and download").read_bytes()
    window.says(" MB in ")
    # the same edits in another folder, run by commands
    again = root / "again" / "project.toml"
    again.parent.mkdir()
    shutil.copytree(project.parent / "uploads", again.parent / "uploads")
    for name in ("project.toml", "placement.json"):
        shutil.copy(project.parent / name, again.parent / name)
    assert str(root) not in (again.parent / "placement.json").read_text()
    assert main(["run", str(again), "--to", "consolidate"]) == 0
    for name in RESULTS:
        assert (project.parent / name).read_bytes() == (again.parent / name).read_bytes(), name
    assert main(["export", str(again), "--to", str(root / "again.ply")]) == 0
    assert shared == (root / "again.ply").read_bytes()
    fetch = partial(window.page.request.get, timeout=0)
    base = window.page.url.partition("?")[0].rstrip("/") + "/files/"
    assert fetch(base + "export/project.ply").body() == shared
    assert not fetch(base + "../project.toml").ok
    assert not fetch(base + "export/../project.toml").ok
