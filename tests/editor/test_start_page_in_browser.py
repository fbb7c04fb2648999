"""In a browser: the start page, the way into a project and back, a reverse proxy, and a second window that watches."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from editor_driver import Editor, Window, state_of, wait_for_job
from front_requests import PROJECT, child_pids, is_alive, kill
from reverse_proxy import ProxyRules, reverse_proxy
from test_hostile_values import made, project
from waiting import wait_until

__all__ = ["made", "project"]
NAMED = "Küche & <b>Flur</b> #1 100%".replace("/", "_")
PORT = 18290


@pytest.fixture
def folder(project: Path) -> Path:
    """A placed project of a ball on a plane, one that was never run, and a broken one."""
    root = project.parent.parent
    for name, text in ((NAMED, PROJECT), ("broken", "[source\n")):
        (root / name).mkdir()
        (root / name / "project.toml").write_text(text)
    return root


@pytest.fixture
def editor(folder: Path) -> Iterator[Editor]:
    made = Editor(folder)
    yield made
    if made.process.poll() is None:
        made.kill()


def card(page: Any, name: str) -> Any:
    """The link of a project by the beginning of its text."""
    return page.get_by_role("link", name=re.compile(f"^{re.escape(name)}"))


def open_project(page: Any, name: str) -> Window:
    """Follow a project's link, by the keyboard."""
    card(page, name).focus()
    page.keyboard.press("Enter")
    window = Window(page)
    window.says("All projects")
    return window


def test_projects_are_found_opened_and_left_again(browser: Any, editor: Editor, project: Path) -> None:
    page = browser.new_page()
    errors: list[str] = []
    page.on("console", lambda entry: errors.append(entry.text) if entry.type == "error" else None)
    page.goto(editor.url)
    assert page.get_by_role("listitem").count() == 3
    card(page, "broken cannot be read project.toml: expected TOML, found").wait_for()
    card(page, f"{NAMED} new nothing was run yet").wait_for()
    card(page, "project unfinished next: relight").wait_for()
    assert page.locator("b b").count() == 0
    for width, height in ((1280, 800), (372, 800)):
        page.set_viewport_size({"width": width, "height": height})
        assert page.evaluate("document.documentElement.scrollWidth") == width
    page.set_viewport_size({"width": 1280, "height": 900})
    # a project that comes and one that goes
    for name in ("later", "broken"):
        there = project.parent.parent / name
        if name == "later":
            there.mkdir()
            (there / "project.toml").write_text(PROJECT)
            card(page, "later").wait_for()
        else:
            (there / "project.toml").unlink()
            card(page, "broken").wait_for(state="detached")
    page.get_by_text("3 projects").wait_for()
    assert errors == []
    window = open_project(page, "project unfinished")
    window.says("all changes are saved")
    # the page survives a reload, and a name that needs quoting does not hinder it
    page.reload()
    window.says("all changes are saved")
    page.get_by_role("link", name="All projects").click()
    card(page, f"{NAMED} new").wait_for()
    # the canvas was drawn, so that the project has a picture now
    preview = project.parent / ".editor" / "preview.jpg"
    if not preview.is_file():
        open_project(page, "project unfinished")
        wait_until(preview.is_file, what="a picture of the canvas", pause=lambda s: page.wait_for_timeout(1000 * s))
        page.get_by_role("link", name="All projects").click()
    picture = card(page, "project unfinished").locator("img")
    picture.wait_for()
    assert picture.evaluate("element => element.decode().then(() => element.naturalWidth)") == 560
    open_project(page, NAMED)
    page.reload()
    window.says("All projects")
    page.close()


def test_a_crash_of_one_project_is_not_one_of_the_others(browser: Any, editor: Editor) -> None:
    page, other = browser.new_page(), browser.new_page()
    page.goto(editor.url)
    open_project(page, "project ")
    (first,) = child_pids(editor)
    other.goto(editor.base)
    other.get_by_text("open in 1 window").wait_for()
    window = open_project(other, NAMED)
    kill(first)
    wait_until(lambda: not is_alive(first), what="the end of one project")
    window.show_phase("Run")
    page.goto(editor.base)
    card(page, "project ").click()
    page.get_by_text("expected its editor to go on, found that it ended").wait_for()
    page.get_by_role("link", name="Open it again").click()
    Window(page).says("all changes are saved")
    page.close()
    other.close()


def test_a_project_behind_a_proxy_is_edited(browser: Any, folder: Path, project: Path) -> None:
    address = f"http://127.0.0.1:{PORT}/splat"
    editor = Editor(folder, "--public-url", address)
    upstream = editor.process
    assert editor.base == address
    try:
        with reverse_proxy(ProxyRules("/splat", True, False), ["127.0.0.1:18080"], PORT):
            page = browser.new_page()
            page.goto(editor.url)
            window = open_project(page, "project ")
            window.show_phase("Place")
            window.click("Duplicate")
            window.until(lambda: len(state_of(project).objects or ()) == 2, what="two objects")
            page.reload()
            window.says("all changes are saved")
            page.get_by_role("link", name="All projects").click()
            page.wait_for_url(f"{address}/")
            assert window.unknown_errors() == []
            page.close()
    finally:
        assert upstream.poll() is None
        editor.kill()


def test_a_second_window_watches_and_takes_over(browser: Any, editor: Editor, project: Path) -> None:
    pages = [browser.new_page() for _ in range(2)]
    windows = []
    for page in pages:
        page.goto(editor.url)
        windows.append(open_project(page, "project "))
    first, second = windows
    second.says("This window is read-only")
    second.click("Watch")
    second.says("You are watching")
    pages[1].get_by_text("This window is read-only").wait_for(state="detached")
    # what the first one does is seen in the second, whose own controls do nothing
    first.show_phase("Place")
    place = pages[1].get_by_role("button", name="\u25cf Place", exact=True)
    place.wait_for()
    second.click("Duplicate")
    first.click("Duplicate")
    first.until(lambda: len(state_of(project).objects or ()) == 2, what="the duplicate of the editing window")
    second.click("Edit here instead")
    first.says("This window is read-only")
    pages[1].get_by_text("You are watching").wait_for(state="detached")
    second.click("Duplicate")
    second.until(lambda: len(state_of(project).objects or ()) == 3, what="the duplicate of the second window")
    first.click("Watch")
    first.says("You are watching")
    # the last window that is left edits
    pages[1].close()
    pages[0].get_by_text("You are watching").wait_for(state="detached")
    first.click("Undo")
    first.until(lambda: len(state_of(project).objects or ()) == 2, what="a step back")
    pages[0].close()


def test_a_job_goes_on_when_the_server_is_killed(browser: Any, editor: Editor, project: Path) -> None:
    page = browser.new_page()
    page.goto(editor.url)
    window = open_project(page, "project ")
    window.show_phase("Run")
    window.start_job(project, "Harmonise and consolidate")
    pids = child_pids(editor)
    editor.kill()
    wait_until(lambda: not any(is_alive(pid) for pid in pids), what="the end of the server's processes")
    page.close()
    wait_for_job(project)
    assert (project.parent / "result" / "scene.ply").is_file()
