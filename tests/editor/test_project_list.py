"""Which projects the start page lists, under which address, and what it says about each."""

import html
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from PIL import Image
from waiting import wait_until

from splatgraft.editor.front.project_folders import ProjectFolder, find_projects, project_folder
from splatgraft.editor.front.project_states import ProjectState, ProjectStates
from splatgraft.editor.front.start_page import ProjectCard, age, problem_page, project_list, start_page
from splatgraft.editor.front.thumbnails import newest_picture, thumbnail
from splatgraft.editor.jobs.jobs import JobState, acquire_job_lock, write_state

NAMES = ["garden", "Küche & Flur #1", "100% <b>bold</b> ?".replace("/", "_"), "..x", "北京"]
CAPTURES = '[source]\ncapture = "a"\n[target]\ncapture = "b"\n'


def made(root: Path, name: str, text: str = CAPTURES) -> Path:
    (root / name).mkdir(parents=True)
    file = root / name / "project.toml"
    file.write_text(text)
    return file


def test_the_folders_of_a_folder_are_listed_under_addresses_without_quoting(tmp_path: Path) -> None:
    for name in NAMES:
        made(tmp_path, name)
    made(tmp_path, ".hidden")
    (tmp_path / "other").mkdir()
    found = find_projects([tmp_path])
    # a name that begins with a dot is hidden
    assert sorted(project.name for project in found) == sorted(set(NAMES) - {"..x"})
    for project in found:
        assert project.key == quote(project.key, safe="")
        assert project.file == tmp_path / project.name / "project.toml"
    assert {project.name: project.key for project in found}["garden"] == "garden"
    assert len({project.key for project in found}) == len(found)
    assert [project.key for project in found] == [project.key for project in find_projects([tmp_path])]


def test_paths_may_be_files_projects_and_folders_and_count_once(tmp_path: Path) -> None:
    for name in ("a/one", "a/two", "b/one"):
        made(tmp_path, name)
    paths = [tmp_path / "a" / "two" / "project.toml", tmp_path / "a", tmp_path / "b" / "one"]
    found = find_projects(paths)
    assert [project.name for project in found] == ["two", "one", "one"]
    assert found[0].key == "two"
    # two folders of one name
    assert all(project.key.startswith("one-") for project in found[1:])
    assert len({project.key for project in found}) == 3


def test_paths_without_projects_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nowhere", tmp_path / "nowhere.toml"):
        with pytest.raises(ValueError, match="expected a project or a folder that holds projects, found"):
            find_projects([path])


def test_names_are_text_and_no_markup(tmp_path: Path) -> None:
    name = "<script>alert('1')</script>".replace("/", "")
    project = project_folder(made(tmp_path, name))
    state = ProjectState("bad", "<img src=x onerror=alert(1)>", 0.0, None)
    cards = [ProjectCard(project, state, 2)]
    pages = (
        start_page(cards, title="<i>work", base='/a"b/'),
        project_list(cards),
        problem_page(project, "<u>bad", "All projects", base="./"),
    )
    for page in pages:
        text = page.decode()
        assert html.escape(name) in text
        assert not any(tag in text for tag in ("<script>", "<img src=x", "<i>", "<u>", 'a"b'))
    assert "open in 2 windows" in pages[1].decode()


def test_ages_are_in_words() -> None:
    now = 10_000_000.0
    for seconds, wanted in ((0, "just now"), (60, "1 minute ago"), (7300, "2 hours ago"), (3 * 86400, "3 days ago")):
        assert age(now - seconds, now) == f"changed {wanted}"
    assert age(now - 90 * 86400, now).startswith("changed on 1970-")
    assert age(0.0, now) == "not saved yet"


def picture(path: Path, color: tuple[int, ...], at: float, size: tuple[int, int] = (640, 480)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB" if len(color) == 3 else "RGBA", size, color).save(path)
    os.utime(path, (at, at))
    return path


def test_the_newest_picture_of_the_project_is_its_thumbnail(tmp_path: Path) -> None:
    root = tmp_path / "project"
    root.mkdir()
    assert newest_picture(root) is None
    report = picture(root / "report" / "after.png", (200, 0, 0), 1000)
    preview = picture(root / ".editor" / "preview.jpg", (0, 200, 0), 2000)
    assert newest_picture(root) == preview
    shared = picture(root / "export" / "b.png", (0, 0, 200, 0), 3000)
    assert newest_picture(root) == shared
    os.utime(report, (4000, 4000))
    assert newest_picture(root) == report
    # what lies outside of the project is not shown
    outside = picture(tmp_path / "secret.png", (1, 2, 3), 5000)
    (root / "export" / "link.png").symlink_to(outside)
    assert newest_picture(root) == report


def test_thumbnails_are_small_and_bad_pictures_have_none(tmp_path: Path) -> None:
    import io

    for size in ((2000, 500), (300, 900), (64, 48)):
        found = thumbnail(picture(tmp_path / "a.png", (200, 10, 10), 1, size))
        assert found is not None
        shown = np.asarray(Image.open(io.BytesIO(found)))
        assert shown.shape == (350, 560, 3)
        # of 255 levels: JPEG
        assert abs(shown.astype(int) - [200, 10, 10]).max() <= 4
    (tmp_path / "b.png").write_bytes(b"no picture")
    assert thumbnail(tmp_path / "b.png") is None
    whole = (tmp_path / "a.png").read_bytes()
    (tmp_path / "c.png").write_bytes(whole[: len(whole) // 2])
    assert thumbnail(tmp_path / "c.png") is None
    # a small file of very many pixels
    Image.new("1", (20_000, 10_000)).save(tmp_path / "d.png")
    assert thumbnail(tmp_path / "d.png") is None
    assert thumbnail(tmp_path / "e.png") is None


@pytest.fixture
def states() -> Iterator[ProjectStates]:
    found = ProjectStates((sys.executable, "-m", "splatgraft.commands.edit_states"), out=None)
    yield found
    found.close()


def settled(states: ProjectStates, project: ProjectFolder, kind: str) -> ProjectState:
    def is_settled() -> bool:
        states.want([project])
        return states.state(project).kind == kind

    wait_until(is_settled, what=f"the state {kind}, not {states.state(project)}")
    return states.state(project)


def test_states_of_projects(states: ProjectStates, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for index in range(3):
            picture(tmp_path / name / f"{index}.jpg", (index, 0, 0), 1)
    text = CAPTURES.replace('"a"', '"../a"').replace('"b"', '"../b"')
    project = project_folder(made(tmp_path, "p", text))
    assert states.state(project).kind == "unknown"
    assert settled(states, project, "new").text == "nothing was run yet"
    project.file.write_text("[source\n")
    found = settled(states, project, "bad")
    assert found.text.startswith("project.toml: expected TOML, found")
    assert len(found.text.splitlines()) == 1
    assert str(tmp_path) not in found.text
    project.file.write_text("x = " + "[" * 5000)
    assert "nested too deeply" in settled(states, project, "bad").text or states.state(project).text
    # a job of the editor
    folder = project.file.parent / ".editor"
    folder.mkdir()
    lock = acquire_job_lock(folder)
    job = JobState("Cut out the object", (), os.getpid(), "running", 1.0, step="segment", done=1, total=4)
    write_state(folder, job)
    assert states.state(project).kind == "running"
    assert states.state(project).text == "Cut out the object, 25% of segment"
    lock.release()
    assert states.state(project).kind != "running"
    (folder / "job.json").write_text(json.dumps({"pid": "x"}))
    assert states.state(project).kind == "bad"


def test_the_end_of_the_process_that_looks_is_said_and_mended(states: ProjectStates, tmp_path: Path) -> None:
    project = project_folder(made(tmp_path, "p", "[source\n"))
    settled(states, project, "bad")
    process = states._process
    assert process is not None
    process.kill()
    process.wait()
    project.file.write_text("[other]\n")
    wait_until(
        lambda: states.want([project]) is None and "expected tables among" in states.state(project).text,
        what="the answer of another process",
    )
