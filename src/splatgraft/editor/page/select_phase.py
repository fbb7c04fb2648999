"""The phase `Select`: select the object in the source by masks or a box, with corrections by hand and by a brush."""

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np
import torch
import viser
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.page.context import PageContext, Phase, note
from splatgraft.editor.page.handles import BoxHandles
from splatgraft.editor.page.photo_clicks import PhotoClicks
from splatgraft.editor.page.scene_view import TINT, Color, camera_from_viser, ray_from_viser
from splatgraft.editor.picking import Ray, Rectangle, brush_selection, in_rectangle, interpolate_rays
from splatgraft.editor.session import Session
from splatgraft.editor.state import BoxNumbers
from splatgraft.editor.worker import LatestOnlyWorker
from splatgraft.segmentation import Box, Keep, default_box

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
_CANVAS, _STROKE = "/brush/canvas", "/source/stroke"


class SelectPhase(Phase):
    """The controls of the phase, and the source in the 3D view."""

    def __init__(self, context: PageContext) -> None:
        """Build the controls."""
        self._context, gui = context, context.gui
        self._count = gui.add_html("")
        self._source = gui.add_dropdown("Masks from", tuple(_SOURCES))
        self._show_box = context.on(gui.add_checkbox("Box around the object", False), self._toggle_box)
        self._lower = gui.add_vector3("Box from", (0.0, 0.0, 0.0), step=0.001, visible=False)
        self._upper = context.on(gui.add_vector3("Box to", (0.0, 0.0, 0.0), step=0.001, visible=False), self._box_typed)
        self._keep = context.on(gui.add_dropdown("Keep pieces", _KEEP), lambda: self._set(keep=self._keep.value))
        self._cut = gui.add_button("Cut out the object", icon=viser.Icon.WAND)
        self._photos = PhotoClicks(context)
        with gui.add_folder("Correct by hand"):
            self._mode = gui.add_dropdown("Strokes", ("remove", "add"))
            self._use_brush = gui.add_checkbox("Brush", False, hint="Drag or click on the picture (key B)")
            self._size = gui.add_slider(
                "Brush size", 0.01, 0.5, 0.01, 0.1, hint="Diameter over the distance to the surface"
            )
            gui.add_markdown("Shift and drag: a rectangle.")
            self._show_correction_box = gui.add_checkbox("Second box", False, hint="Adds or removes everything in it")
            self._box_group = gui.add_button_group("All in it", ("Add", "Remove"), visible=False)
            self._clear = gui.add_button("Clear all strokes", icon=viser.Icon.ERASER, color="gray")
        self._isolate = context.on(gui.add_checkbox("Show the object alone", False), lambda: None)
        server, view = context.server, context.view
        self._handles = BoxHandles(server, view, "/source/box", color=(255, 150, 40), on_dragged=self._box_dragged)
        self._correction_handles = BoxHandles(server, view, "/source/correction_box", color=(60, 160, 255))
        self._brush = Brush(context, on_stroke=self._apply_stroke, color=lambda: _ADDS if self._adds() else _REMOVES)
        self._shown_box: BoxNumbers | None = None
        """What the fields of the box show. They are written only where the state has something else: the value of a
        refresh would arrive while the next number is typed, and replace it."""
        context.on(self._source, lambda: self._set(mask_source=_SOURCES[self._source.value]))
        context.on(self._lower, self._box_typed)
        context.on(self._cut, lambda: context.run("segment", "Cut out the object"))
        context.on(self._use_brush, self._say_brush)
        context.on(self._size, lambda: None)
        context.on(self._show_correction_box, self._toggle_correction_box)
        context.on(self._box_group, self._apply_box)
        context.on(gui.add_command("Brush on or off", hotkey="B"), self._toggle_brush)
        context.on(self._clear, lambda: self._set(corrections=None))

    def enter(self) -> None:
        """Take rectangles from the 3D view."""
        self._context.server.scene.on_rect_select(modifier="shift")(self._rectangle_drawn)

    def leave(self) -> None:
        """Hide what belongs to the phase alone."""
        self._context.server.scene.remove_rect_select_callback(self._rectangle_drawn)
        self._brush.deactivate()
        self._photos.leave()
        self._handles.hide()
        self._correction_handles.hide()

    def refresh(self) -> None:
        """Update the source in the view, selection, counts and box."""
        session = self._context.session
        if session is None:
            return
        if not session.files.source_scene.is_file():
            self._count.content = note("The source is not reconstructed yet: see Open.")
            return
        if not self._is_read(session):
            return
        state, box = session.state, session.box()
        name = next((n for n, value in _SOURCES.items() if value == (state.mask_source or "auto")), None)
        if name is not None:
            self._source.value = name
        self._keep.value = state.keep or _KEEP[0]
        self._show_box.value = self._lower.visible = self._upper.visible = box is not None
        if state.box is not None and state.box != self._shown_box:
            self._lower.value, self._upper.value = state.box[:3], state.box[3:]
            self._shown_box = state.box
        self._clear.disabled = state.corrections is None
        self._draw(session)
        # last, as it hides the splats
        self._photos.refresh()
        if self._photos.is_shown:
            self._show_correction_box.value = False
        self._box_group.visible = self._show_correction_box.value
        if not self._show_correction_box.value:
            self._correction_handles.hide()
        if box is not None and not self._photos.is_shown:
            self._handles.show(box)
        else:
            self._handles.hide()
        if self._use_brush.value and not self._photos.is_shown:
            self._brush.activate(session.scenes.gaussians(session.files.source_scene), size=float(self._size.value))
        else:
            self._brush.deactivate()

    def _is_read(self, session: Session) -> bool:
        """Whether the source is at hand; otherwise a sample of it is shown until it is."""
        path, scenes = session.files.source_scene, session.scenes
        if scenes.at_hand([path]):
            return True
        self._context.view.show_coarse(path, scenes.sample(path))
        self._count.content = note(scenes.reading_note(path))
        return False

    def _draw(self, session: Session) -> None:
        scene, selection, view = self._scene(), session.selection(), self._context.view
        assert selection is not None
        view.show_splats("/source/object", scene, which=selection, tint=None if self._isolate.value else TINT)
        if self._isolate.value:
            view.hide_splats("/source/rest")
        else:
            view.show_splats("/source/rest", scene, which=session.scenes.complement("selected", selection))
        view.remove_coarse()
        kind = "the object" if session.scenes.segmented() is not None else "inside the box"
        shown = [s for n, s in view.shown.items() if n.startswith("/source") and s.count < s.total]
        limited = f"<br>{sum(s.count for s in shown):,} are shown; the files contain all" if shown else ""
        self._count.content = note(f"<b>{int(selection.sum()):,}</b> of {scene.count:,} Gaussians are {kind}{limited}")

    def _scene(self) -> Gaussians:
        session = self._context.require_session()
        return session.scenes.gaussians(session.files.source_scene)

    def _set(self, **fields: object) -> None:
        session = self._context.require_session()
        session.change(replace(session.state, **fields))  # pyright: ignore[reportArgumentType]

    # the box

    def _toggle_box(self) -> None:
        if not self._show_box.value:
            self._set(box=None)
        elif self._context.require_session().box() is None:
            self._set_box(self._default_box())
            self._context.say("drag the two corners until the box contains the object but not its support")

    def _default_box(self) -> Box:
        """The box around the cameras' common focus; where there is no capture, the middle half of the scene."""
        session = self._context.require_session()
        try:
            return default_box(session.scenes.capture(session.files.source_cameras))
        except ValueError:
            lower, upper = self._scene().means.quantile(torch.tensor([0.25, 0.75]), 0)
            return Box(lower, torch.maximum(upper, lower + 1e-6))

    def _set_box(self, box: Box) -> None:
        self._set(box=tuple(round(x, 6) for x in (*box.lower.tolist(), *box.upper.tolist())))

    def _box_typed(self) -> None:
        typed = (*self._lower.value, *self._upper.value)
        self._shown_box = None  # so that the fields go back to the state where these numbers are refused
        self._set(box=typed)
        self._shown_box = typed

    def _box_dragged(self, box: Box) -> None:
        self._context.callback(lambda _: self._set_box(box))(None)

    # corrections by hand

    def _toggle_brush(self) -> None:
        if self._context.phase == "Select":
            self._use_brush.value = not self._use_brush.value
            self._say_brush()

    def _say_brush(self) -> None:
        on = "the brush is on: drag or click in the view; B switches it off, so that a drag rotates the view again"
        self._context.say(on if self._use_brush.value else "the brush is off")

    def _toggle_correction_box(self) -> None:
        if self._show_correction_box.value:
            box = self._context.require_session().box() or self._default_box()
            self._correction_handles.show(box.grown(1.1))

    def _rectangle_drawn(self, event: viser.SceneRectSelectEvent) -> None:
        if not self._photos.is_shown:
            self._context.callback(self._apply_rectangle)(event)

    def _apply_rectangle(self, event: viser.SceneRectSelectEvent) -> None:
        camera = camera_from_viser(event.client.camera, width=1000)
        self._apply_stroke(in_rectangle(self._scene().means, camera, Rectangle(event.screen_min, event.screen_max)))

    def _apply_box(self) -> None:
        if self._correction_handles.box is None:
            raise ValueError("box: expected one in view, found none")
        inside = self._correction_handles.box.contains(self._scene().means)
        self._correct(inside, add=self._box_group.value == "Add")

    def _adds(self) -> bool:
        return self._mode.value == "add"

    def _apply_stroke(self, touched: Tensor) -> None:
        self._correct(touched, add=self._adds())

    def _correct(self, touched: Tensor, *, add: bool) -> None:
        self._context.require_session().correct(touched, add=add)
        done = "added" if add else "removed"
        self._context.say(f"{done}: {int(touched.sum()):,} Gaussians under the stroke; cut again to use it")


class Brush:
    """While active, the left mouse button paints; the selection is shown during the stroke."""

    def __init__(
        self, context: PageContext, *, on_stroke: Callable[[Tensor], None], color: Callable[[], Color]
    ) -> None:
        """Start inactive; `on_stroke` gets the selected Gaussians, which are shown in `color` during the stroke."""
        self._context, self._on_stroke, self._color = context, on_stroke, color
        self._scene: Gaussians | None = None
        self._size = 0.1
        self._canvas: viser.IcosphereHandle | None = None
        self._rays: tuple[Ray, ...] = ()
        self._rays_done, self._selected = 0, torch.zeros(0, dtype=torch.bool)
        self._worker = LatestOnlyWorker(self._paint, context.say_error)
        context.on_close.append(self._worker.close)

    def activate(self, scene: Gaussians, *, size: float) -> None:
        """Paint on `scene`; `size` is the diameter of the brush over the distance of the hit point."""
        self._scene, self._size = scene, size
        if self._canvas is not None:
            return
        centre = scene.means.median(0).values
        # an invisible sphere around camera and scene receives the drags
        self._canvas = self._context.server.scene.add_icosphere(
            _CANVAS,
            radius=1000 * float((scene.means - centre).norm(dim=1).median()) + 1e-6,
            position=centre.numpy(),
            subdivisions=1,
            opacity=0.0,
            side="back",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._canvas.on_drag("left")(self._dragged)
        # clicks are taken from the scene: viser outlines a clickable node under the pointer
        self._context.server.scene.on_click()(self._clicked)

    def deactivate(self) -> None:
        """Stop painting; the left mouse button rotates the view again."""
        if self._canvas is not None:
            self._context.server.scene.remove_click_callback(self._clicked)
            self._canvas.remove()
            self._canvas = None

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        self._rays, self._rays_done = (ray_from_viser(event),), 0
        self._worker.submit(True)

    async def _dragged(self, event: viser.SceneNodeDragEvent[viser.IcosphereHandle]) -> None:
        origin = _vector(event.client.camera.position)
        if event.phase == "start":
            self._rays, self._rays_done = (Ray(origin, _vector(event.start_position) - origin),), 0
        ray = Ray(origin, _vector(event.end_position) - origin)
        self._rays = (*self._rays, *interpolate_rays(self._rays[-1], ray, size=self._size))
        self._worker.submit(event.phase == "end")

    def _paint(self, ended: bool) -> None:
        scene, rays = self._scene, self._rays
        if scene is None:
            return
        if self._rays_done == 0:
            self._selected = torch.zeros(scene.count, dtype=torch.bool)
        new, self._rays_done = rays[self._rays_done :], len(rays)
        selected = self._selected | brush_selection(scene, new, size=self._size)
        changed = not torch.equal(selected, self._selected)
        self._selected = selected
        if ended:
            self._context.callback(lambda _: self._finish_stroke(selected))(None)
        elif changed:
            self._context.view.show_splats(_STROKE, scene.select(selected), tint=self._color())

    def _finish_stroke(self, selected: Tensor) -> None:
        self._context.view.remove_splats(_STROKE)
        if not bool(selected.any()):
            raise ValueError("brush: expected a surface under the stroke, found none")
        self._on_stroke(selected)


def _vector(values: object) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)
