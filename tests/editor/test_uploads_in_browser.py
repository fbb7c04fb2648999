"""In a browser: an upload survives a lost network, a reload, another step and a killed process; cancel removes it."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from editor_driver import Editor, Window
from front_requests import answer, child_pids, is_alive, kill
from relay import Relay, relayed
from tiny_project import ball
from upload_requests import arriving
from waiting import wait_until

from splatgraft.core.gaussians import concatenate
from splatgraft.formats import write_gaussians

PORT, LABEL = 18380, "Upload a video or a scene"
RATE = 1.5e6
"""Bytes a second of the network."""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of about 6 MB, so four seconds of the network."""
    path = tmp_path_factory.mktemp("files") / "many balls.ply"
    write_gaussians(path, concatenate([ball()] * 1100))
    return path


@pytest.fixture
def project(tmp_path: Path) -> Path:
    made = tmp_path / "project" / "project.toml"
    made.parent.mkdir()
    return made


@pytest.fixture
def editor(project: Path) -> Iterator[Editor]:
    made = Editor(project)
    yield made
    made.kill()


@pytest.fixture
def network() -> Iterator[Relay]:
    with relayed(PORT, 18080, rate=RATE) as made:
        yield made


def opened(browser: Any, editor: Editor) -> Window:
    page = browser.new_page()
    page.goto(editor.url.replace("18080", str(PORT)))
    window = Window(page)
    page.get_by_role("group", name=LABEL).wait_for()
    return window


def begin(window: Window, file: Path, project: Path) -> None:
    """Choose a file and wait until a part of it has arrived."""
    window.upload(LABEL, file)
    window.until(lambda: has_arrived(project) > 300_000, what="the first parts")


def has_arrived(project: Path) -> int:
    return sum(path.stat().st_size for path in arriving(project))


def is_stored(project: Path, file: Path) -> None:
    stored = project.parent / "uploads" / "many_balls.ply"
    wait_until(stored.is_file, what="the stored file")
    assert stored.read_bytes() == file.read_bytes()
    assert arriving(project) == []


def test_a_lost_network_is_waited_for(browser: Any, editor: Editor, network: Relay, project: Path, file: Path) -> None:
    window = opened(browser, editor)
    begin(window, file, project)
    bar = window.page.get_by_role("progressbar", name="Upload of many balls.ply")
    bar.wait_for()
    network.cut()
    window.says("The upload continues by itself")
    before = has_arrived(project)
    # as a browser reports it where the network goes
    window.page.context.set_offline(True)
    assert before > 0
    network.restore()
    window.page.context.set_offline(False)
    window.says("It continues at")
    window.says("many_balls.ply: stored as")
    is_stored(project, file)
    bar.wait_for(state="hidden")
    assert window.field("Object from").input_value().endswith("many_balls.ply")
    window.page.close()


def test_a_page_that_is_loaded_again_says_what_can_be_continued(
    browser: Any, editor: Editor, network: Relay, project: Path, file: Path
) -> None:
    window = opened(browser, editor)
    begin(window, file, project)
    window.page.reload()
    window.says("have arrived; choose the file again to continue")
    before = has_arrived(project)
    window.upload(LABEL, file)
    text = window.page.get_by_text("It continues at").first.inner_text()
    shown = re.search(r"continues at ([0-9.]+) MB", text)
    assert shown is not None
    assert float(shown[1]) >= before / 1e6 - 0.1
    is_stored(project, file)
    window.page.close()


def test_another_step_leaves_the_upload_alone_and_cancel_removes_it(
    browser: Any, editor: Editor, network: Relay, project: Path, file: Path
) -> None:
    window = opened(browser, editor)
    begin(window, file, project)
    window.show_phase("Run")
    progress = window.page.locator("splatgraft-upload-progress")
    progress.get_by_role("button", name="Cancel the upload").wait_for()
    before = has_arrived(project)
    window.until(lambda: has_arrived(project) > before, what="parts that arrive in another step")
    window.show_phase("Open")
    progress.get_by_role("button", name="Cancel the upload").wait_for(state="hidden")
    window.click("Cancel the upload")
    window.says("The upload was cancelled")
    wait_until(lambda: arriving(project) == [], what="removed parts")
    # by keyboard, and of a file that is dropped
    choose = window.page.get_by_role("button", name=LABEL)
    assert choose.is_enabled()
    choose.focus()
    with window.page.expect_file_chooser():
        window.page.keyboard.press("Enter")
    drop(window, "page.html", "<html>")
    window.says("page.html: expected a file that ends in")
    assert window.unknown_errors() == []
    window.page.close()


def drop(window: Window, name: str, text: str) -> None:
    data = window.page.evaluate_handle(
        """([name, text]) => {
          const data = new DataTransfer();
          data.items.add(new File([text], name));
          return data;
        }""",
        [name, text],
    )
    window.page.locator("splatgraft-upload .zone").first.dispatch_event("drop", {"dataTransfer": data})


def test_a_killed_process_of_a_project_is_started_again_and_the_upload_goes_on(
    browser: Any, network: Relay, project: Path, file: Path
) -> None:
    # beyond loopback a project is served by a process of its own
    editor = Editor(project, "--host", "0.0.0.0")
    try:
        page = browser.new_page()
        address = editor.url.replace("0.0.0.0:18080", f"127.0.0.1:{PORT}")
        page.goto(address)
        window = Window(page)
        page.get_by_role("group", name=LABEL).wait_for()
        begin(window, file, project)
        (first,) = child_pids(editor)
        kill(first)
        wait_until(lambda: not is_alive(first), what="the end of the process")
        assert has_arrived(project) > 0
        # whoever opens the page starts the process again
        cookie = answer(address, follow=False)[1]["Set-Cookie"].partition(";")[0]
        inner = f"{address.partition('?')[0]}p/project/"
        wait_until(lambda: b"<title>Viser</title>" in answer(inner, Cookie=cookie)[2], what="the process started again")
        window.says("It continues at")
        is_stored(project, file)
        page.close()
    finally:
        editor.kill()
