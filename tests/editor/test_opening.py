"""A large scene opens as a sample of it, which input does not wait for; the whole scene follows."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest
from editor import Client
from editor_pages import opened_page, sends, served
from waiting import wait_until

from splatgraft.editor import scene_cache
from splatgraft.editor.page import opening
from splatgraft.editor.page.opening import Opening
from splatgraft.editor.page.page import Page
from splatgraft.editor.page.server import GuardedServer
from splatgraft.editor.project import Project
from splatgraft.editor.scene_sample import read_sample
from splatgraft.editor.state_files import read_state
from splatgraft.formats import read_gaussians

MOST = 60
"""Gaussians of the sample; the target has 144."""


class Opened:
    """A server in front of a project whose target takes as long to read as the test wants."""

    def __init__(self, project: Path, guarded: GuardedServer) -> None:
        self.may_be_read = threading.Event()
        self.project, self.guarded = project, guarded
        self.opening = Opening(guarded.viser, project, project.parent)
        self.client = Client(f"http://127.0.0.1:{guarded.port}/?token=secret")
        self.client.look(0.0)
        self.seen: list[tuple[str, str]] = []
        self.page: Page | None = None

    def open_page(self) -> Page:
        self.page = Page(self.guarded, Project(self.project), budget=1000, opening=self.opening)
        return self.page

    def read(self, path: Path) -> Any:
        if path.parent.parent.name == "target":
            self.may_be_read.wait()
        return read_gaussians(path)

    def sees(self, kind: str, name: str = "") -> bool:
        for message in self.client.messages(0.2):
            if message["type"] != "BackgroundImageMessage" or message["rgb_data"] is not None:
                self.seen.append((message["type"], message.get("name", "")))
        return any(found[0] == kind and found[1].startswith(name) for found in self.seen)

    def close(self) -> None:
        self.may_be_read.set()
        self.client.close()
        if self.page is not None:
            self.page.close()


@pytest.fixture
def opened(project: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Opened]:
    monkeypatch.setattr(scene_cache, "_LARGE_BYTES", 0)
    monkeypatch.setattr(opening, "read_sample", lambda path: read_sample(path, most=MOST))
    monkeypatch.setattr(scene_cache, "read_sample", lambda path: read_sample(path, most=MOST))
    with served() as guarded:
        found = Opened(project, guarded)
        monkeypatch.setattr(scene_cache, "read_gaussians", found.read)
        yield found
        found.close()


def test_a_sample_comes_first_and_input_does_not_wait_for_the_rest(opened: Opened) -> None:
    # before the page is there
    wait_until(lambda: opened.sees("PointCloudMessage", "/coarse"), what="the sample")
    wait_until(lambda: opened.sees("SetCameraPositionMessage"), what="the view of the first camera")
    page = opened.open_page()
    session, place = page.context.require_session(), cast("Any", page.phases["Place"])
    scene, view = page.context.server.scene, page.context.view
    coarse = scene.get_handle_by_name("/coarse")
    assert 0 < len(cast("Any", coarse).points) <= MOST
    assert page.context.phase == "Place"
    # the renderer's picture is of the sample, too
    wait_until(lambda: opened.sees("BackgroundImageMessage"), what="a picture of the sample")
    # the caption follows the picture
    wait_until(lambda: opened.sees("x") or "being read" in opened.client.caption(), what="its caption")
    assert "Light transfer" not in opened.client.caption()
    # the object can be moved, and the page answers, while the target is read
    wait_until(lambda: place._position.visible, what="the object's numbers")
    x, y, z = place._position.value
    sends(place._position, (x + 0.1, y, z))
    objects = read_state(session.files.file).objects
    assert objects is not None
    assert not session.scenes.at_hand(session.placed_scenes())
    page.show_phase("Run")
    page.show_phase("Open")
    page.show_phase("Place")
    assert not opened.sees("GaussianSplatsMessage", "/target/scene")
    assert scene.get_handle_by_name("/coarse") is not None
    opened.may_be_read.set()
    wait_until(lambda: opened.sees("GaussianSplatsMessage", "/target/scene"), what="the whole scene")
    wait_until(lambda: opened.sees("RemoveSceneNodeMessage", "/coarse"), what="the end of the sample")
    wait_until(lambda: view.is_shown("/target/scene"), what="the target")
    shown = view.shown["/target/scene"]
    assert shown.count == shown.total > MOST
    order = [name for kind, name in opened.seen if kind in ("GaussianSplatsMessage", "RemoveSceneNodeMessage")]
    assert order.index("/target/scene") < len(order) - 1 - order[::-1].index("/coarse")
    wait_until(lambda: opened.sees("x") or "Light transfer" in opened.client.caption(), what="the relit scene")


def test_a_scene_that_cannot_be_read_is_named(opened: Opened) -> None:
    page = opened.open_page()
    target = page.context.require_session().files.target_scene
    text = target.read_bytes().replace(b"property float opacity", b"property float opacitx")
    target.write_bytes(text)
    opened.may_be_read.set()
    page.refresh()
    wait_until(lambda: "opacity" in page.context.status.content, what="what is wrong with the file")
    page.show_phase("Run")


def test_nothing_is_shown_early_where_the_files_may_be_others(project: Path) -> None:
    with served() as guarded:
        for text in ("[compose]\ntarget = 'x.ply'\n", "[segment]\nscene = 'x.ply'\n", "not toml", "compose = 3\n"):
            project.write_text(text)
            found = Opening(guarded.viser, project, project.parent)
            assert (found.scene is None) == (text != "compose = 3\n")


def test_the_source_is_sampled_where_nothing_is_cut_out_yet(project: Path) -> None:
    (project.parent / "object" / "object.ply").unlink()
    with opened_page(project, opening=True) as page:
        assert page.context.phase == "Select"
        assert page.context.view.is_shown("/source/object")
        assert page.context.server.scene.get_handle_by_name("/coarse") is None
