"""The handles of an object: what a drag does to its placement, through the real page and viser's events."""

import asyncio
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from test_hostile_values import made, page_of, project
from viser import TransformControlsEvent

from splatgraft.editor.session.state_files import read_state

__all__ = ["made", "project"]


def drag(handler: Any, handle: Any, *, position: Any = None, wxyz: Any = None) -> None:
    """What viser does when a browser drags a handle and releases it."""
    for phase in ("start", "update", "end"):
        if phase != "start" and position is not None:
            handle.position = np.asarray(position, dtype=float)
        if phase != "start" and wxyz is not None:
            handle.wxyz = np.asarray(wxyz, dtype=float)
        asyncio.run(handler(TransformControlsEvent(None, None, handle, phase)))  # pyright: ignore[reportArgumentType]


def placed(project: Path) -> Any:
    objects = read_state(project).objects
    assert objects is not None
    return objects[0].target_from_object


def test_drags_move_turn_and_scale_with_and_without_snapping(project: Path) -> None:
    page, close = page_of(project)
    try:
        page.show_phase("Place")
        place = cast("Any", page._phases["Place"])
        gizmo, session = place._gizmo, page.require_session()
        foot = session.placeable_object(0).base.point
        before = session.objects()[0].target_from_object
        stands = before.points(foot)
        # handles have a size on the screen and are drawn over the scene
        assert gizmo._move.fixed
        assert gizmo._scale.fixed
        assert not gizmo._move.depth_test

        # the arrow above the object, twice as high: twice the size, and the foot stays
        top = np.asarray(gizmo._scale.position)
        drag(gizmo._scaled, gizmo._scale, position=stands.numpy() + 2 * (top - stands.numpy()))
        assert placed(project).scale == pytest.approx(2 * before.scale, rel=1e-4)
        assert torch.allclose(placed(project).points(foot), stands, atol=1e-4)
        # below the ground a smallest size is left
        drag(gizmo._scaled, gizmo._scale, position=stands.numpy() - np.array([0, 0, 5.0]))
        assert placed(project).scale == pytest.approx(0.04 * before.scale, rel=1e-3)
        assert session.undo()
        assert session.undo()
        page.refresh()

        # a quarter above the ground, turned by 20 degrees: as it is without snapping, on the ground and by 15 with it
        half = np.radians(20.0) / 2
        moved = {"position": stands.numpy() + np.array([0.1, 0, 0.12]), "wxyz": (np.cos(half), 0, 0, np.sin(half))}
        drag(gizmo._moved, gizmo._move, **moved)
        assert torch.allclose(placed(project).points(foot), torch.tensor(moved["position"]).float(), atol=1e-4)
        assert angle(placed(project)) == pytest.approx(20.0, abs=1e-3)
        assert session.undo()
        place._toggle_snap()
        page.refresh()
        drag(gizmo._moved, gizmo._move, **moved)
        assert angle(placed(project)) == pytest.approx(15.0, abs=1e-3)
        # the plane is 0.01 thick
        assert abs(float(placed(project).points(foot)[2])) < 0.05
        # one step of undo per drag
        assert session.undo()
        assert torch.allclose(session.objects()[0].target_from_object.translation, before.translation, atol=1e-5)

        # numbers that cannot be are refused, and the project opens
        drag(gizmo._moved, gizmo._move, position=(np.nan, 0, 0))
        assert "expected a number" in page._status.content
        read_state(project)
    finally:
        close()


def angle(move: Any) -> float:
    return float(np.degrees(np.arctan2(float(move.rotation[1, 0]), float(move.rotation[0, 0]))))
