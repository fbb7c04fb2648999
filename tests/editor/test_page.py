"""The page without a browser: the real server and page, with the messages that a browser would send."""

import asyncio
import html
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from editor_pages import AROUND_THE_BALL, arrives, is_handled, opened_page, sends
from viser import ClientHandle, TransformControlsEvent, UploadedFile
from waiting import wait_until

from splatgraft.cli import main
from splatgraft.editor.page.page import Page
from splatgraft.editor.project import Project
from splatgraft.editor.session import Session
from splatgraft.editor.state_files import read_state
from splatgraft.project.metric_scale import MetricScale, read_scale, write_scale
from splatgraft.relighting import LayerWeights, Light, LightSource
from splatgraft.relighting.light.light import fit_ambient


def phase_of(page: Page, name: str) -> Any:
    page.show_phase(name)
    return cast("Any", page.phases[name])


def mark_of(page: Page, phase: str) -> str:
    """Return the mark before the name of a phase."""
    return next(option for option in page._phase_buttons.options if option.endswith(phase)).partition(" ")[0]


def status(page: Page) -> str:
    return page.context.status.content


# typed numbers


def test_a_refresh_leaves_a_typed_box_alone(page: Page) -> None:
    select, session = phase_of(page, "Select"), page.context.require_session()
    lower, upper = select._lower, select._upper
    assert (*lower.value, *upper.value) == pytest.approx(AROUND_THE_BALL, abs=0)
    arrives(lower, (-0.3, -0.35, 0.03))
    page.refresh()
    assert lower.value == (-0.3, -0.35, 0.03)
    is_handled(lower)
    assert read_state(session.files.file).box == (-0.3, -0.35, 0.03, 0.35, 0.35, 0.65)
    # impossible values are refused, and the fields show the present ones again
    sends(lower, (9.0, -0.35, 0.03))
    assert lower.value == (-0.3, -0.35, 0.03)
    session.change(replace(session.state, box=(-0.2, -0.2, 0.0, 0.2, 0.2, 0.5)))
    page.refresh()
    assert (*lower.value, *upper.value) == (-0.2, -0.2, 0.0, 0.2, 0.2, 0.5)


def test_a_refresh_leaves_a_typed_position_alone_and_numbers_that_cannot_be_are_refused(page: Page) -> None:
    place, session = phase_of(page, "Place"), page.context.require_session()
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
    scale = place._scale.value
    for value in (0.0, -2.0, math.nan, math.inf):
        sends(place._scale, value)
        assert "expected a number" in status(page)
        assert place._scale.value == scale
    Session(Project(session.files.file))


def test_the_object_s_height_is_shown_and_typed_in_centimetres(page: Page) -> None:
    place, session = phase_of(page, "Place"), page.context.require_session()
    size, before = place._size, session.objects()[0].target_from_object
    base = session.placeable_object(0).base
    # without scales the page says how to get them
    assert not size._height.visible
    assert "what the project says: 0.8 times" in size._note.content
    sends(place._scale, 1.0)
    assert "type the object's true height" in html.unescape(size._note.content)
    assert session.undo()
    page.refresh()
    for height in (0.0, -1.0, math.nan, math.inf):
        for which in ("its photos", "the place"):
            arrives(size._known, height)
            sends(size._set, which)
            assert "height in cm: expected a number from" in status(page)
    assert read_scale(session.files.source_cameras) is None
    assert read_scale(session.files.target_cameras) is None
    arrives(size._known, 12.0)
    sends(size._set, "the place")
    found = read_scale(session.files.target_cameras)
    assert found is not None
    assert found.metres_per_unit == pytest.approx(0.12 / (before.scale * base.height))
    assert size._height.visible
    assert size._height.value == pytest.approx(12.0)
    assert session.objects()[0].target_from_object.scale == before.scale
    # a typed height changes the scale, and the foot stays
    arrives(size._height, 18.0)
    page.refresh()
    assert size._height.value == 18.0
    is_handled(size._height)
    after = session.objects()[0].target_from_object
    assert after.scale == pytest.approx(1.5 * before.scale)
    assert after.points(base.point).tolist() == pytest.approx(before.points(base.point).tolist(), abs=1e-5)
    sends(size._height, math.nan)
    assert size._height.value == pytest.approx(18.0)
    # with the other scale the object gets its true size
    assert not size._true_size.visible
    arrives(size._known, 24.0)
    sends(size._set, "its photos")
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
    assert session.true_scale() == pytest.approx(2.0 * before.scale)
    # a broken file is named, and the rest of the phase stays usable
    path = write_scale(session.files.target_cameras, MetricScale(1.0, "a test"))
    path.write_text("{")
    page.refresh()
    assert str(path) in size._note.content
    assert not size._height.visible


def test_the_strength_of_a_source_stays_as_it_was_set(page: Page) -> None:
    light, session = phase_of(page, "Light"), page.context.require_session()
    suns = tuple(LightSource((0.0, 0.6, 0.8), (value,) * 3, name=name) for value, name in ((2.0, "sun"), (0.5, "lamp")))
    session.change(replace(session.placed_state(), light=Light(sources=suns, ambient=fit_ambient(torch.ones(3)))))
    page.refresh()
    assert light._strength.value == 1
    sends(light._strength, 3.0)
    assert light._strength.value == 3
    assert session.state.light is not None
    assert session.state.light.sources[0].irradiance == pytest.approx((6.0, 6.0, 6.0))
    # relative to the earlier source, not to the present one; a dark source is not lost either
    sends(light._strength, 0.0)
    sends(light._strength, 0.5)
    assert session.state.light.sources[0].irradiance == pytest.approx((1.0, 1.0, 1.0))
    assert session.state.light.sources[1] == suns[1]
    # nor does another change of it begin anew
    sends(light._softness, 5.0)
    assert light._strength.value == 0.5
    assert session.state.light.sources[0].angular_radius_deg == 5.0
    sends(light._source_choice, "2: lamp")
    assert light._strength.value == 1


def test_sliders_weigh_the_layers_of_the_transfer_that_is_there(page: Page) -> None:
    light, session = phase_of(page, "Light"), page.context.require_session()
    sliders = light._sliders
    assert {key: slider.value for key, slider in sliders.items()} == asdict(LayerWeights())
    relit = session.relighting.relit(session.placed_state())
    before = session.relighting.scene(session.placed_state())
    # one plane shows little of the light, and the page says so
    page.refresh()
    assert (relit.report[0].text if relit.light is None else "Estimated: ") in html.unescape(light._text.content)
    for key, value in (("exposure", 1.0), ("tint", 0.5), ("shadow", 0.25)):
        sends(sliders[key], value)
    assert read_state(session.files.file).weights == LayerWeights(exposure=1.0, tint=0.5, shadow=0.25)
    # the same layers, by identity
    assert session.relighting.relit(session.placed_state()) is relit
    after = session.relighting.scene(session.placed_state())
    objects = relit.bake()[1]
    assert after.count == before.count
    assert float((after.sh - before.sh)[objects, 0].mean()) > 0.1
    # a computed value needs no key in project.toml
    for key, value in asdict(LayerWeights()).items():
        sends(sliders[key], value)
    assert "exposure" not in session.files.file.read_text()
    assert torch.equal(session.relighting.scene(session.placed_state()).sh, before.sh)


# drags


def drag(handler: Any, handle: Any, *, position: Any = None, wxyz: Any = None) -> None:
    """Drag a handle and release it, as viser does for a browser."""
    for phase in ("start", "update", "end"):
        if phase != "start" and position is not None:
            handle.position = np.asarray(position, dtype=float)
        if phase != "start" and wxyz is not None:
            handle.wxyz = np.asarray(wxyz, dtype=float)
        asyncio.run(handler(TransformControlsEvent(None, None, handle, phase)))  # pyright: ignore[reportArgumentType]


def test_drags_move_turn_and_scale_with_and_without_snapping(page: Page) -> None:
    place, session = phase_of(page, "Place"), page.context.require_session()
    # the pointer drags the object itself unless the handles are shown
    assert place._gizmo._move is None
    sends(place._has_gizmo, True)
    gizmo, foot = place._gizmo, session.placeable_object(0).base.point
    before = session.objects()[0].target_from_object
    stands = before.points(foot)

    def placed() -> Any:
        objects = read_state(session.files.file).objects
        assert objects is not None
        return objects[0].target_from_object

    def turned() -> float:
        return float(np.degrees(np.arctan2(float(placed().rotation[1, 0]), float(placed().rotation[0, 0]))))

    # handles have a size on the screen and are drawn over the scene
    assert gizmo._move.fixed
    assert gizmo._scale.fixed
    assert not gizmo._move.depth_test
    # the arrow above the object, twice as high: twice the size, and the foot stays
    top = np.asarray(gizmo._scale.position)
    drag(gizmo._scaled, gizmo._scale, position=stands.numpy() + 2 * (top - stands.numpy()))
    assert placed().scale == pytest.approx(2 * before.scale, rel=1e-4)
    assert torch.allclose(placed().points(foot), stands, atol=1e-4)
    # a minimum size remains below the ground
    drag(gizmo._scaled, gizmo._scale, position=stands.numpy() - np.array([0, 0, 5.0]))
    assert placed().scale == pytest.approx(0.04 * before.scale, rel=1e-3)
    for _ in range(2):
        assert session.undo()
    page.refresh()
    # a quarter above the ground, turned by 20 degrees: free without snapping; on the ground and by 15 degrees with it
    half = np.radians(20.0) / 2
    moved = {"position": stands.numpy() + np.array([0.1, 0, 0.12]), "wxyz": (np.cos(half), 0, 0, np.sin(half))}
    drag(gizmo._moved, gizmo._move, **moved)
    assert torch.allclose(placed().points(foot), torch.tensor(moved["position"]).float(), atol=1e-4)
    assert turned() == pytest.approx(20.0, abs=1e-3)
    assert session.undo()
    place._toggle_snap()
    page.refresh()
    drag(gizmo._moved, gizmo._move, **moved)
    assert turned() == pytest.approx(15.0, abs=1e-3)
    # the plane is 0.01 thick
    assert abs(float(placed().points(foot)[2])) < 0.05
    # one step of undo per drag
    assert session.undo()
    assert torch.allclose(session.objects()[0].target_from_object.translation, before.translation, atol=1e-5)
    # impossible numbers are refused, and the project opens
    drag(gizmo._moved, gizmo._move, position=(np.nan, 0, 0))
    assert "expected a number" in status(page)
    read_state(session.files.file)


def test_objects_are_duplicated_added_by_an_upload_and_parts_of_the_target_erased(page: Page, made: Path) -> None:
    place, session = phase_of(page, "Place"), page.context.require_session()
    sends(place._object_buttons, "Duplicate")
    first, second = (item.target_from_object for item in session.objects())
    assert float((second.translation - first.translation)[:2].norm()) > 0.2
    assert abs(float((second.translation - first.translation)[2])) < 0.05
    assert torch.equal(first.rotation, second.rotation)
    content = (made / "project" / "object" / "object.ply").read_bytes()
    button = next(
        handle
        for handle in page.context.gui._gui_input_handle_from_uuid.values()
        if isinstance(handle.value, UploadedFile) and handle.label == "Upload a file"
    )
    # twice the same file is one, another one of that name has a number
    for name, sent in (("../../a.ply", content), ("a.ply", content), ("a.ply", content + b" ")):
        sends(button, UploadedFile(name, sent))
    folder = session.files.file.parent / "uploads"
    assert sorted(path.name for path in folder.iterdir()) == ["a.ply", "a_2.ply"]
    assert (folder / "a.ply").read_bytes() == content
    assert [path.object_path for path in session.objects()[2:4]] == [folder / "a.ply"] * 2
    sends(button, UploadedFile(".ply", b""))
    assert "expected a file with a suffix" in status(page)
    sends(place._show_box, True)
    is_handled(place._erase)
    erased = read_state(session.files.file).erased
    assert erased is not None
    assert 0 < int(erased.sum()) < len(erased)
    is_handled(place._restore)
    assert read_state(session.files.file).erased is None
    while session.undo():
        pass
    assert len(session.objects()) == 1


def test_erased_flags_of_another_target_leave_the_page_usable(project: Path) -> None:
    session = Session(Project(project))
    count = session.scenes.gaussians(session.files.target_scene).count
    session.change(replace(session.placed_state(), erased=torch.arange(count) > 3))
    np.save(project.parent / "erased.npy", np.zeros(3, bool))
    with opened_page(project) as page:
        place = phase_of(page, "Place")
        assert "expected one flag per Gaussian of the target" in status(page)
        place._restore_all()
        assert read_state(project).erased is None


# unreadable project files


BAD_TABLES = [
    "[relight]\nshadow = nan\n",
    "[relight]\nshadow = [[[]]]\n",
    "[relight]\ngiven_light = 7\n",
    '[segment]\nkeep = "bogus"\n',
    '[harmonize]\nmethod = "bogus"\n',
    "segment = 7\n",
    "x = " + "[" * 20_000 + "\n",
    "\x00",
]


def test_a_bad_project_file_is_said_and_opened_by_itself_once_it_is_corrected(project: Path) -> None:
    good = project.read_text()
    project.write_text("[")
    with opened_page(project) as page:
        context = page.context
        for text in BAD_TABLES:
            project.write_text(text + good.replace("[segment]", "[other]").replace("[compose]", "[more]"))
            page.poll()
            assert context.session is None, text
            assert "project.toml" in (context.problem or "")
            assert "\n" not in (context.problem or "")
            assert context.phase == "Open"
            assert "Correct the file" in cast("Any", page.phases["Open"])._problem.content
        project.write_text(good)
        page.poll()
        assert context.session is not None
        assert context.problem is None
        assert context.phase == "Place"


# results that no longer belong to the edits


def test_a_stale_result_is_marked_with_the_button_that_renews_it(project: Path) -> None:
    assert main(["run", str(project), "--to", "consolidate"]) == 0
    with opened_page(project) as page:
        run, session = phase_of(page, "Run"), page.context.require_session()
        assert "The result is up to date" in run._note.content
        share = phase_of(page, "Share")
        assert not share._stale.visible
        wait_until(lambda: mark_of(page, "Run") == "\u2713", what="the mark of what is done")
        session.change(replace(session.state, weights=LayerWeights(shadow=0.5)))
        page.refresh()
        assert "The result is out of date: you changed the light" in share._stale.content
        wait_until(lambda: mark_of(page, "Run") == "\u21bb", what="the mark of what is out of date")
        sends(share._kind, "Scene, exact (.ply)")
        is_handled(share._write)
        wait_until(lambda: share._bar.visible, what="the progress of the export")
        wait_until(lambda: "it is out of date (you changed the light" in status(page), what="the end of the export")
        assert session.jobs._child is not None
        session.jobs._child.wait()
        assert " MB in " in status(page)
        assert not share._bar.visible
        assert (session.files.root / "export" / "project.ply").is_file()
        page.preview.show("Copy-paste", "Result")
        camera = session.scenes.cameras(session.files.target_cameras)[0].resized(0.2)
        request = page.preview._request()
        assert request is not None
        page.preview._draw(replace(request, camera=camera), note="")
        assert "the result is out of date" in page.preview._caption.content
        assert session.undo()
        page.refresh()
        assert not share._stale.visible
        placed = session.objects()[0].target_from_object
        session.set_placement(0, replace(placed, translation=placed.translation + 0.01))
        page.refresh()
        assert "out of date: you moved the object" in share._stale.content
        phase_of(page, "Run")
        assert "out of date: you moved the object" in run._note.content
        # after undoing, the picture belongs to the edits again
        page.show_phase("Place")
        assert page.preview._right.value == "Light transfer"


def test_a_picture_that_was_begun_before_select_is_not_shown_there(page: Page) -> None:
    page.show_phase("Place")
    request = page.preview._request()
    assert request is not None
    parts = {name: MagicMock() for name in ("scene", "gui", "_websock_connection")}
    window = MagicMock(spec=ClientHandle, client_id=1, **parts)
    late = replace(
        request, window=window, camera=request.camera.resized(0.2), left="Target alone", right="Target alone"
    )
    page.preview._is_on_canvas = True
    page.preview._draw_once(late, note="", stage="full quality")
    assert page.preview.canvas.is_shown
    page.show_phase("Select")
    page.preview._draw_once(late, note="", stage="full quality")
    assert not page.preview.canvas.is_shown
