"""Results that no longer belong to the edits are marked where they are shown, compared and exported."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast
from unittest.mock import MagicMock

import pytest
from test_hostile_values import made, page_of, project
from viser import ClientHandle, GuiEvent
from waiting import wait_until

from splatgraft.cli import main
from splatgraft.commands.edit_project import FlowProject
from splatgraft.editor.session.session import Session
from splatgraft.relighting import LayerWeights

__all__ = ["made", "project"]


@dataclass(frozen=True)
class Reasons(FlowProject):
    """A project whose reasons are given."""

    given: Mapping[str, str | None] | None = None

    def reasons(self) -> Mapping[str, str | None]:
        assert self.given is not None
        return self.given


def test_the_first_stale_step_is_named(project: Path) -> None:
    def why(**given: str | None) -> str | None:
        return Session(Reasons(project, given=given)).why_stale("consolidate")

    assert why(relight=None, consolidate=None) is None
    assert why(relight="options changed", render="waits for relight", consolidate="waits for render") == (
        "relight: options changed"
    )
    assert why(project="project.toml: expected TOML") == "project.toml: expected TOML"


@pytest.mark.long
def test_a_stale_result_is_marked_with_the_button_that_renews_it(project: Path) -> None:
    assert main(["run", str(project), "--to", "consolidate"]) == 0
    page, close = page_of(project)
    try:
        page.show_phase("Run")
        run, session = cast("Any", page._phases["Run"]), page.require_session()
        share = run._share
        assert not run._stale.visible
        assert not run._renew.visible
        session.change(replace(session.state, weights=LayerWeights(shadow=0.5)))
        page.refresh()
        assert "relight: " in run._stale.content
        assert run._renew.visible
        share._kind.value = "Scene, exact (.ply)"
        page.refresh()
        for callback in share._write._impl.update_cb:
            callback(GuiEvent(client=None, client_id=0, target=share._write))
        wait_until(lambda: share._bar.visible, what="the progress of the export")
        wait_until(lambda: "it is out of date (relight: " in page._status.content, what="the end of the export")
        assert " MB in " in page._status.content
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
        assert not run._stale.visible
    finally:
        close()


def test_a_picture_that_was_begun_before_select_is_not_shown_there(project: Path) -> None:
    page, close = page_of(project)
    try:
        page.show_phase("Place")
        request = page.preview._request()
        assert request is not None
        window = MagicMock(spec=ClientHandle, client_id=1, scene=MagicMock(), _websock_connection=MagicMock())
        late = replace(
            request, window=window, camera=request.camera.resized(0.2), left="Target alone", right="Target alone"
        )
        page.preview._is_on_canvas = True
        page.preview._draw_once(late, note="", stage="final")
        assert page.preview.canvas.is_shown
        page.show_phase("Select")
        page.preview._draw_once(late, note="", stage="final")
        assert not page.preview.canvas.is_shown
    finally:
        close()
