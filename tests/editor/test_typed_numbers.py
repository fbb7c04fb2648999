"""Numbers typed in the page: the real server and page, with the messages that a browser would send."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from test_scenes_without_photos import AROUND_THE_BALL, scene_project
from viser import GuiEvent

from splatgraft.cli import main
from splatgraft.commands.edit_project import FlowProject
from splatgraft.editor.access.access_control import AccessControl
from splatgraft.editor.page.page import Page, PageOptions
from splatgraft.editor.page.server import GuardedServer
from splatgraft.editor.session.object_size import true_scale
from splatgraft.editor.session.state_files import read_state
from splatgraft.formats.metric_scale import MetricScale, read_scale, write_scale
from splatgraft.relighting import LayerWeights


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    project = scene_project(tmp_path, suffix=".ply", box=AROUND_THE_BALL, mask_source="box")
    assert main(["run", str(project), "--to", "compose"]) == 0
    access = AccessControl("secret")
    guarded = GuardedServer(access, host="127.0.0.1", port=0)
    made = Page(guarded, FlowProject(project), PageOptions(budget=1000, inside=None))
    yield made
    made.close()
    guarded.close()


def arrives(handle: Any, value: Any) -> None:
    """What viser does first with a value that a browser sends."""
    handle._impl.value = value


def is_handled(handle: Any) -> None:
    """What viser does next, in another thread."""
    for callback in handle._impl.update_cb:
        callback(GuiEvent(client=None, client_id=0, target=handle))  # pyright: ignore[reportArgumentType]


def test_a_refresh_leaves_a_typed_box_alone(page: Page) -> None:
    page.show_phase("Select")
    select, session = cast("Any", page._phases["Select"]), page.require_session()
    lower, upper = select._lower, select._upper
    assert (*lower.value, *upper.value) == pytest.approx(AROUND_THE_BALL, abs=0)
    arrives(lower, (-0.3, -0.35, 0.03))
    page.refresh()
    assert lower.value == (-0.3, -0.35, 0.03)
    is_handled(lower)
    assert read_state(session.files.file).box == (-0.3, -0.35, 0.03, 0.35, 0.35, 0.65)
    # what cannot be is refused, and the fields show again what is
    arrives(lower, (9.0, -0.35, 0.03))
    is_handled(lower)
    assert lower.value == (-0.3, -0.35, 0.03)
    session.change(replace(session.state, box=(-0.2, -0.2, 0.0, 0.2, 0.2, 0.5)))
    page.refresh()
    assert (*lower.value, *upper.value) == (-0.2, -0.2, 0.0, 0.2, 0.2, 0.5)


def test_a_refresh_leaves_a_typed_position_alone(page: Page) -> None:
    page.show_phase("Place")
    place, session = cast("Any", page._phases["Place"]), page.require_session()
    x, y, z = place._position.value
    arrives(place._position, (x + 0.1, y, z))
    page.refresh()
    assert place._position.value == (x + 0.1, y, z)
    before = session.objects()[0].target_from_object.translation
    is_handled(place._position)
    moved = session.objects()[0].target_from_object.translation - before
    assert moved.tolist() == pytest.approx([0.1, 0, 0], abs=1e-5)
    session.set_placement(0, replace(session.objects()[0].target_from_object, translation=before))
    page.refresh()
    assert place._position.value == pytest.approx((x, y, z), abs=1e-5)


def clicked(handle: Any, value: str) -> None:
    """A click on one button of a group."""
    arrives(handle, value)
    is_handled(handle)


def test_the_object_s_height_is_shown_and_typed_in_centimetres(page: Page) -> None:
    page.show_phase("Place")
    size, session = cast("Any", page._phases["Place"])._size, page.require_session()
    before = session.objects()[0].target_from_object
    base = session.placeable_object(0).base
    # without scales it says how to get them
    assert not size._height.visible
    assert "splatgraft scale" in size._note.content
    arrives(size._known, 12.0)
    clicked(size._set, "the place")
    place = read_scale(session.files.target_cameras)
    assert place is not None
    assert place.metres_per_unit == pytest.approx(0.12 / (before.scale * base.height))
    assert size._height.visible
    assert size._height.value == pytest.approx(12.0)
    assert session.objects()[0].target_from_object.scale == before.scale
    # a typed height changes the scale, and the foot stays where it is
    arrives(size._height, 18.0)
    page.refresh()
    assert size._height.value == 18.0
    is_handled(size._height)
    after = session.objects()[0].target_from_object
    assert after.scale == pytest.approx(1.5 * before.scale)
    assert after.points(base.point).tolist() == pytest.approx(before.points(base.point).tolist(), abs=1e-5)
    # with the other scale the object gets its true size
    assert not size._true_size.visible
    arrives(size._known, 24.0)
    clicked(size._set, "its capture")
    assert session.objects()[0].target_from_object.scale == pytest.approx(2.0 * before.scale)
    assert size._height.value == pytest.approx(24.0, abs=0.01)
    assert "24 cm tall" in size._note.content
    assert session.undo()
    page.refresh()
    assert size._height.value == pytest.approx(18.0, abs=0.01)
    assert size._true_size.visible
    is_handled(size._true_size)
    assert size._height.value == pytest.approx(24.0, abs=0.01)
    # a place that is found later has that size, as in `compose`, unless project.toml gives another
    assert true_scale(session) == pytest.approx(2.0 * before.scale)


@pytest.mark.parametrize("height", [0.0, -1.0, float("nan"), float("inf")])
def test_a_height_that_cannot_be_is_refused(page: Page, height: float) -> None:
    page.show_phase("Place")
    size, session = cast("Any", page._phases["Place"])._size, page.require_session()
    for which in ("its capture", "the place"):
        arrives(size._known, height)
        clicked(size._set, which)
        assert "height in cm: expected a number from" in page._status.content
    assert read_scale(session.files.source_cameras) is None
    assert read_scale(session.files.target_cameras) is None
    # a broken file is named, and the rest of the phase stays usable
    path = write_scale(session.files.target_cameras, MetricScale(1.0, "a test"))
    page.refresh()
    shown, scale = size._height.value, session.objects()[0].target_from_object.scale
    arrives(size._height, height)
    is_handled(size._height)
    assert size._height.value == shown
    assert session.objects()[0].target_from_object.scale == scale
    path.write_text("{")
    page.refresh()
    assert str(path) in size._note.content
    assert not size._height.visible


def test_sliders_weigh_the_layers_of_the_transfer_that_is_there(page: Page) -> None:
    page.show_phase("Light")
    sliders, session = cast("Any", page._phases["Light"])._sliders, page.require_session()
    assert {key: slider.value for key, slider in sliders.items()} == asdict(LayerWeights())
    relit = session.relighting.relit(session.placed_state())
    before = session.relighting.scene(session.placed_state())
    for key, value in (("exposure", 1.0), ("tint", 0.5), ("shadow", 0.25)):
        arrives(sliders[key], value)
        is_handled(sliders[key])
    assert read_state(session.files.file).weights == LayerWeights(exposure=1.0, tint=0.5, shadow=0.25)
    # the same layers, by identity
    assert session.relighting.relit(session.placed_state()) is relit
    after = session.relighting.scene(session.placed_state())
    objects = relit.bake()[1]
    assert after.count == before.count
    assert float((after.sh - before.sh)[objects, 0].mean()) > 0.1
    # what is as computed needs no key in project.toml
    for key, value in asdict(LayerWeights()).items():
        arrives(sliders[key], value)
        is_handled(sliders[key])
    assert "exposure" not in session.files.file.read_text()
    assert torch.equal(session.relighting.scene(session.placed_state()).sh, before.sh)
