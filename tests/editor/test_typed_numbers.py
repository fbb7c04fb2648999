"""Numbers typed in the page: the real server and page, with the messages that a browser would send."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
from test_scenes_without_photos import AROUND_THE_BALL, scene_project
from viser import GuiEvent

from splatgraft.cli import main
from splatgraft.commands.edit_project import FlowProject
from splatgraft.editor.access.access_control import AccessControl
from splatgraft.editor.page.page import Page, PageOptions
from splatgraft.editor.page.server import GuardedServer
from splatgraft.editor.session.state_files import read_state


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
