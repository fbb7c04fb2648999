"""A large scene opens as points of a sample, read without torch; input does not wait for the whole scene."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from editor import Client
from editor_pages import cloud, opened_page, sends, served
from shapes import ring
from waiting import wait_until

from splatgraft.core.spherical_harmonics import C0
from splatgraft.editor import scene_cache
from splatgraft.editor.page import opening
from splatgraft.editor.page.opening import Opening, read_first_view
from splatgraft.editor.page.page import Page
from splatgraft.editor.page.server import GuardedServer
from splatgraft.editor.project import Project
from splatgraft.editor.scene_sample import read_sample
from splatgraft.editor.state_files import read_state
from splatgraft.formats import read_gaussians, write_cameras, write_gaussians

MOST = 60
"""Number of Gaussians in the sample; the target has 144."""


def test_a_sample_is_solid_rows_of_the_file(tmp_path: Path) -> None:
    scene, path = cloud(1000, 0), tmp_path / "scene.ply"
    write_gaussians(path, scene)
    sample, whole = read_sample(path, most=200), read_sample(path)
    assert sample is not None
    assert whole is not None
    solid = np.arange(0, 1000, 5)[(scene.opacity_logits > 0).numpy()[::5]]
    assert np.array_equal(sample.rows, solid)
    assert (sample.total, len(whole.rows)) == (1000, int((scene.opacity_logits > 0).sum()))
    assert np.array_equal(sample.points, scene.means[solid].numpy())
    assert np.allclose(sample.colors, (0.5 + C0 * scene.sh[solid, 0]).clamp(0, 1).numpy(), atol=1e-6)
    # fewer points are larger
    assert sample.point_size > 2 * whole.point_size > 0
    erased = np.zeros(1000, bool)
    erased[solid[:30]] = True
    assert np.array_equal(sample.without(erased).rows, solid[30:])
    assert sample.without(erased[:-1]) is sample
    # Gaussians that no renderer draws are left out
    scene.means[solid[0], 0] = torch.nan
    write_gaussians(path, scene)
    assert (broken := read_sample(path, most=200)) is not None
    assert np.array_equal(broken.rows, solid[1:])


def test_files_of_other_layouts_have_no_sample(tmp_path: Path) -> None:
    for name in ("scene.ply", "scene.compressed.ply", "scene.spz"):
        write_gaussians(tmp_path / name, cloud(600, 0))
    whole = (tmp_path / "scene.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[:-5])
    (tmp_path / "none.ply").write_bytes(whole.replace(b"vertex 600", b"vertex 0").partition(b"end_header\n")[0])
    (tmp_path / "ascii.ply").write_bytes(whole.replace(b"binary_little_endian", b"ascii"))
    (tmp_path / "empty.ply").write_bytes(b"")
    for name in ("scene.compressed.ply", "scene.spz", "cut.ply", "none.ply", "ascii.ply", "empty.ply", "missing.ply"):
        assert read_sample(tmp_path / name) is None, name


def test_the_first_view_is_through_the_first_camera(tmp_path: Path) -> None:
    cameras = ring(3, height=1.0, size=(320, 200))
    write_cameras(tmp_path / "transforms.json", cameras)
    view = read_first_view(tmp_path / "transforms.json")
    assert view is not None
    # precision of float32 for numbers near 3
    assert np.allclose(view.world_from_camera, cameras.world_from_camera[0], atol=1e-6)
    assert view.half_height == pytest.approx(100 / float(cameras.intrinsics[0, 1, 1]))
    assert view.aspect == pytest.approx(1.6)
    for text in ("", "{}", '{"frames": []}', "[1]", '{"frames": [{"transform_matrix": [[1]]}], "w": 1, "h": 1}'):
        (tmp_path / "transforms.json").write_text(text)
        assert read_first_view(tmp_path / "transforms.json") is None


class Opened:
    """Server in front of a project whose target takes a chosen time to read."""

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
    for module in (opening, scene_cache):
        monkeypatch.setattr(module, "read_sample", lambda path: read_sample(path, most=MOST))
    with served() as guarded:
        found = Opened(project, guarded)
        monkeypatch.setattr(scene_cache, "read_gaussians", found.read)
        yield found
        found.close()


def test_a_sample_comes_first_and_input_does_not_wait_for_the_rest(opened: Opened) -> None:
    # before the page is complete
    wait_until(lambda: opened.sees("PointCloudMessage", "/coarse"), what="the sample")
    wait_until(lambda: opened.sees("SetCameraPositionMessage"), what="the view of the first camera")
    page = opened.open_page()
    session, place = page.context.require_session(), cast("Any", page.phases["Place"])
    scene, view = page.context.server.scene, page.context.view
    coarse = scene.get_handle_by_name("/coarse")
    assert 0 < len(cast("Any", coarse).points) <= MOST
    assert page.context.phase == "Place"
    wait_until(lambda: opened.sees("x") or "being read" in opened.client.caption(), what="its caption")
    assert "Light transfer" not in opened.client.caption()
    # the object can be moved, and the page answers, while the target is read
    wait_until(lambda: place._position.visible, what="the object's numbers")
    x, y, z = place._position.value
    sends(place._position, (x + 0.1, y, z))
    assert read_state(session.files.file).objects is not None
    assert not session.scenes.at_hand(session.placed_scenes())
    for phase in ("Run", "Open", "Place"):
        page.show_phase(phase)
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
    assert opened.sees("BackgroundImageMessage")


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
        for text in ("[compose]\ntarget = 'x.ply'\n", "[segment]\nscene = 'x.ply'\n", "not toml", "compose = 3\n", ""):
            project.write_text(text)
            found = Opening(guarded.viser, project, project.parent)
            assert (found.scene is None) == bool(text)


def test_the_source_is_sampled_where_nothing_is_cut_out_yet(project: Path) -> None:
    (project.parent / "object" / "object.ply").unlink()
    with opened_page(project, opening=True) as page:
        assert page.context.phase == "Select"
        assert page.context.view.is_shown("/source/object")
        assert page.context.server.scene.get_handle_by_name("/coarse") is None
