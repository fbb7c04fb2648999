"""The phase `Select`: select the object in the source by masks or a box, with corrections by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, get_args

import torch
import viser

from splatgraft.editor.page.box_handles import BoxHandles
from splatgraft.editor.page.brush import Brush
from splatgraft.editor.page.photo_clicks import PhotoClicks
from splatgraft.editor.page.scene_view import TINT, Color, camera_from_viser
from splatgraft.editor.session.edit_state import BoxNumbers
from splatgraft.editor.session.picking import Rectangle, in_rectangle
from splatgraft.editor.session.session import Session
from splatgraft.formats import read_capture
from splatgraft.segmentation import Box, Keep, default_box

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_SOURCES = {
    "masks beside the photos, else cut from them": "auto",
    "masks beside the photos": "files",
    "a box around the object": "grabcut",
    "a network (BiRefNet)": "birefnet",
    "no masks: everything inside the box": "box",
}


_KEEP: tuple[str, ...] = get_args(Keep)
_ADDS: Color = (0.2, 0.9, 0.3)
_REMOVES: Color = (0.9, 0.1, 0.2)


class SelectPhase:
    """The controls of the phase, and the source in the 3D view."""

    def __init__(self, page: Page) -> None:
        """Build the controls."""
        self._page, gui = page, page.gui
        self._count = gui.add_html("")
        self._source = gui.add_dropdown("Masks from", tuple(_SOURCES), initial_value=next(iter(_SOURCES)))
        self._show_box = gui.add_checkbox("Box around the object", False)
        self._lower = gui.add_vector3("Box from", (0.0, 0.0, 0.0), step=0.001, visible=False)
        self._upper = gui.add_vector3("Box to", (0.0, 0.0, 0.0), step=0.001, visible=False)
        self._keep = gui.add_dropdown("Keep pieces", _KEEP, initial_value=_KEEP[0])
        self._cut = gui.add_button("Cut out the object", icon=viser.Icon.WAND)
        self._photos = PhotoClicks(page)
        with gui.add_folder("Correct by hand"):
            self._mode = gui.add_dropdown("Strokes", ("remove", "add"), initial_value="remove")
            self._use_brush = gui.add_checkbox("Brush", False, hint="Drag or click on the picture (key B)")
            self._size = gui.add_slider(
                "Brush size", 0.01, 0.5, 0.01, 0.1, hint="Diameter over the distance to the surface"
            )
            gui.add_markdown("Shift and drag: a rectangle.")
            self._show_correction_box = gui.add_checkbox("Second box", False, hint="Adds or removes everything in it")
            self._box_group = gui.add_button_group("All in it", ("Add", "Remove"), visible=False)
            self._clear = gui.add_button("Clear all strokes", icon=viser.Icon.ERASER, color="gray")
        self._isolate = gui.add_checkbox("Show the object alone", False)
        self._handles = BoxHandles(page.server, page.view, "/source/box", color=(255, 150, 40))
        self._handles.on_dragged = self._box_dragged
        self._correction_handles = BoxHandles(page.server, page.view, "/source/correction_box", color=(60, 160, 255))
        self._brush = Brush(page, on_stroke=self._apply_stroke, color=lambda: _ADDS if self._adds() else _REMOVES)
        self._is_active = False
        self._shown_box: BoxNumbers | None = None
        """What the fields of the box show. They are written only where the state has something else: the value of a
        refresh would arrive while the next number is typed, and replace it."""
        self._connect()

    def enter(self) -> None:
        """Show the source, or update it where it is shown."""
        if not self._is_active:
            self._page.server.scene.on_rect_select(modifier="shift")(self._rectangle_drawn)
        self._is_active = True
        session = self._page.session
        if session is None or self._is_read(session):
            self._draw()

    def leave(self) -> None:
        """Hide the source."""
        if self._is_active:
            self._page.server.scene.remove_rect_select_callback(self._rectangle_drawn)
        self._is_active = False
        self._brush.deactivate()
        self._photos.leave()
        self._page.view.hide_splats("/source")
        self._handles.hide()
        self._correction_handles.hide()

    def refresh(self) -> None:
        """Update selection, counts and box."""
        session = self._page.session
        if session is None or not self._is_active:
            return
        if session.files.source_scene.is_file() and not self._is_read(session):
            return
        state = session.state
        name = next((n for n, value in _SOURCES.items() if value == (state.mask_source or "auto")), None)
        if name is not None:
            self._source.value = name
        self._keep.value = state.keep or _KEEP[0]
        box = session.box()
        self._show_box.value = box is not None
        self._lower.visible = self._upper.visible = self._show_box.value
        if state.box is not None and state.box != self._shown_box:
            self._lower.value, self._upper.value = state.box[:3], state.box[3:]
            self._shown_box = state.box
        if self._show_box.value and box is not None:
            self._handles.show(box)
        else:
            self._handles.hide()
        self._box_group.visible = self._show_correction_box.value
        if not self._show_correction_box.value:
            self._correction_handles.hide()
        if self._use_brush.value and session.files.source_scene.is_file():
            scene = session.scenes.gaussians(session.files.source_scene)
            self._brush.activate(scene, size=float(self._size.value))
        else:
            self._brush.deactivate()
        self._clear.disabled = state.corrections is None
        self._draw()
        # last, as it hides the splats
        self._photos.refresh()
        if self._photos.is_shown:
            self._show_correction_box.value = self._box_group.visible = False
            self._handles.hide()
            self._correction_handles.hide()
            self._brush.deactivate()

    def _connect(self) -> None:
        callback = self._page.callback
        self._source.on_update(callback(lambda _: self._set(mask_source=_SOURCES[self._source.value])))
        self._keep.on_update(callback(lambda _: self._set(keep=self._keep.value)))
        self._show_box.on_update(callback(lambda _: self._toggle_box()))
        for field in (self._lower, self._upper):
            field.on_update(callback(lambda _: self._box_typed()))
        self._cut.on_click(callback(lambda _: self._page.run("segment", "Cut out the object")))
        self._isolate.on_update(callback(lambda _: None))
        self._use_brush.on_update(callback(lambda _: self._say_brush()))
        self._size.on_update(callback(lambda _: None))
        self._show_correction_box.on_update(callback(lambda _: self._toggle_correction_box()))
        self._box_group.on_click(callback(lambda event: self._apply_box(add=event.target.value == "Add")))
        self._page.gui.add_command("Brush on or off", hotkey="B").on_trigger(callback(lambda _: self._toggle_brush()))
        self._clear.on_click(callback(lambda _: self._set(corrections=None)))

    def _is_read(self, session: Session) -> bool:
        """Whether the source is at hand; otherwise a sample of it is shown until it is."""
        path, scenes = session.files.source_scene, session.scenes
        if self._page.loading.has(session, [path]):
            return True
        self._page.view.show_coarse(path, scenes.sample(path))
        self._count.content = _line(scenes.reading_note(path))
        return False

    def _draw(self) -> None:
        session = self._page.session
        if session is None or not session.files.source_scene.is_file():
            self._count.content = _line("The source is not reconstructed yet: see Open.")
            return
        scene, selection = session.scenes.gaussians(session.files.source_scene), session.selection()
        assert selection is not None
        self._page.view.show_splats(
            "/source/object", scene, which=selection, tint=None if self._isolate.value else TINT
        )
        if self._isolate.value:
            self._page.view.hide_splats("/source/rest")
        else:
            self._page.view.show_splats("/source/rest", scene, which=session.scenes.complement("selected", selection))
        self._page.view.remove_coarse()
        kind = "the object" if session.scenes.segmented() is not None else "inside the box"
        shown = [s for n, s in self._page.view.shown.items() if n.startswith("/source") and s.count < s.total]
        limited = f"<br>{sum(s.count for s in shown):,} are shown; the files contain all" if shown else ""
        self._count.content = _line(f"<b>{int(selection.sum()):,}</b> of {scene.count:,} Gaussians are {kind}{limited}")

    def _set(self, **fields: object) -> None:
        session = self._page.require_session()
        session.change(replace(session.state, **fields))  # pyright: ignore[reportArgumentType]

    def _toggle_box(self) -> None:
        session = self._page.require_session()
        if not self._show_box.value:
            self._set(box=None)
        elif session.box() is None:
            self._set_box(self._default_box())
            self._page.say("drag the two corners until the box contains the object but not its support")

    def _default_box(self) -> Box:
        """The box around the cameras' common focus; where there is no capture, the middle half of the scene."""
        session = self._page.require_session()
        try:
            return default_box(read_capture(session.files.source_cameras.parent))
        except ValueError:
            means = session.scenes.gaussians(session.files.source_scene).means
            lower, upper = means.quantile(torch.tensor([0.25, 0.75]), 0)
            return Box(lower, torch.maximum(upper, lower + 1e-6))

    def _set_box(self, box: Box) -> None:
        a, b, c = (round(x, 6) for x in box.lower.tolist())
        d, e, f = (round(x, 6) for x in box.upper.tolist())
        self._set(box=(a, b, c, d, e, f))

    def _box_typed(self) -> None:
        typed = (*self._lower.value, *self._upper.value)
        self._shown_box = None  # so that the fields go back to the state where these numbers are refused
        Box(torch.tensor(typed[:3]), torch.tensor(typed[3:]))
        self._shown_box = typed
        self._set(box=typed)

    def _box_dragged(self, box: Box, ended: bool) -> None:
        if ended:
            self._page.callback(lambda _: self._set_box(box))(None)

    def _toggle_brush(self) -> None:
        if self._is_active:
            self._use_brush.value = not self._use_brush.value
            self._say_brush()

    def _say_brush(self) -> None:
        on = "the brush is on: drag or click in the view; B switches it off, so that a drag rotates the view again"
        self._page.say(on if self._use_brush.value else "the brush is off")

    def _toggle_correction_box(self) -> None:
        if self._show_correction_box.value:
            box = self._page.require_session().box() or self._default_box()
            self._correction_handles.show(box.grown(1.1))

    def _rectangle_drawn(self, event: viser.SceneRectSelectEvent) -> None:
        if self._photos.is_shown:
            return
        self._page.callback(self._apply_rectangle)(event)

    def _apply_rectangle(self, event: viser.SceneRectSelectEvent) -> None:
        session = self._page.require_session()
        scene = session.scenes.gaussians(session.files.source_scene)
        camera = camera_from_viser(event.client.camera, width=1000)
        self._apply_stroke(in_rectangle(scene.means, camera, Rectangle(event.screen_min, event.screen_max)))

    def _apply_box(self, *, add: bool) -> None:
        session, box = self._page.require_session(), self._correction_handles.box
        if box is None:
            raise ValueError("box: expected one in view, found none")
        self._correct(box.contains(session.scenes.gaussians(session.files.source_scene).means), add=add)

    def _adds(self) -> bool:
        return self._mode.value == "add"

    def _apply_stroke(self, touched: torch.Tensor) -> None:
        self._correct(touched, add=self._adds())

    def _correct(self, touched: torch.Tensor, *, add: bool) -> None:
        self._page.require_session().correct(touched, add=add)
        self._page.say(
            f"{'added' if add else 'removed'}: {int(touched.sum()):,} Gaussians under the stroke; cut again to use it"
        )


def _line(text: str) -> str:
    return f'<div style="font-size:.85em;line-height:1.6;padding:2px 12px">{text}</div>'
