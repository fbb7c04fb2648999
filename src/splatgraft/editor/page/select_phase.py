"""The phase `Select`: select the object by clicks in photos or in the scene, by masks or a box, and by a brush."""

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np
import torch
import viser
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.page.context import PageContext, Phase, SceneClicks, note
from splatgraft.editor.page.handles import BoxHandles
from splatgraft.editor.page.preview_panel import PreviewPanel
from splatgraft.editor.page.scene_view import Color, camera_from_viser, ray_from_viser
from splatgraft.editor.photo_view import PhotoView, seen_best, with_click
from splatgraft.editor.picking import (
    Ray,
    Rectangle,
    brush_selection,
    first_surface_hit,
    in_rectangle,
    interpolate_rays,
)
from splatgraft.editor.pictures import TINT
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
_CLICKS = ("the object", "what is beside it")
_STROKES = ("removes", "adds")
_TAKES_POINTS = (None, "auto", "grabcut", "sam2")
"""Values of `mask_source` of which clicks count."""
_ADDS: Color = (0.2, 0.9, 0.3)
_REMOVES: Color = (0.9, 0.1, 0.2)
_CANVAS, _STROKE = "/brush/canvas", "/source/stroke"


class SelectPhase(Phase):
    """The controls of the phase, and the source in the 3D view."""

    def __init__(self, context: PageContext, preview: PreviewPanel) -> None:
        """Build the controls."""
        self._context, self._preview, gui = context, preview, context.gui
        self._note = gui.add_html("")
        self._kind = context.on(gui.add_dropdown("A click marks", _CLICKS), lambda: None)
        self._photo = gui.add_slider("Photo", 1, 2, 1, 1, hint="Also by the arrow keys; drag the view to leave it")
        self._cut = gui.add_button("Cut out the object", icon=viser.Icon.WAND)
        self._use_brush = gui.add_checkbox(
            "Brush", False, hint="Drag over the picture (key B); Shift and drag: a rectangle"
        )
        self._mode = gui.add_dropdown("The brush", _STROKES)
        self._isolate = context.on(gui.add_checkbox("Object alone", False), self._set_alone)
        with context.more_of("Select"):
            self._clear_points = gui.add_button("Forget all clicks", color="gray")
            self._size = gui.add_slider("Brush size", 0.01, 0.5, 0.01, 0.1, hint="Over the distance to the surface")
            self._clear = gui.add_button("Forget all strokes", icon=viser.Icon.ERASER, color="gray")
            self._source = gui.add_dropdown("Outlines from", tuple(_SOURCES))
            self._keep = context.on(gui.add_dropdown("Keep pieces", _KEEP), lambda: self._set(keep=self._keep.value))
            self._show_box = context.on(gui.add_checkbox("Box around the object", False), self._toggle_box)
            self._lower = gui.add_vector3("Box from", (0.0, 0.0, 0.0), step=0.001, visible=False)
            self._upper = context.on(
                gui.add_vector3("Box to", (0.0, 0.0, 0.0), step=0.001, visible=False), self._box_typed
            )
            self._show_correction_box = gui.add_checkbox("Second box", False, hint="Adds or removes everything in it")
            self._box_group = gui.add_button_group("All in it", ("Add", "Remove"), visible=False)
        server, view = context.server, context.view
        self._handles = BoxHandles(server, view, "/source/box", color=(255, 150, 40), on_dragged=self._box_dragged)
        self._correction_handles = BoxHandles(server, view, "/source/correction_box", color=(60, 160, 255))
        self._brush = Brush(context, on_stroke=self._apply_stroke, color=lambda: _ADDS if self._adds() else _REMOVES)
        self._shown_box: BoxNumbers | None = None
        """What the fields of the box show. They are written only where the state has something else: the value of a
        refresh would arrive while the next number is typed, and replace it."""
        self._clicks = SceneClicks(context, self._mark)
        context.on(self._photo, lambda: preview.to_camera(int(self._photo.value) - 1))
        context.on(self._source, lambda: self._set(mask_source=_SOURCES[self._source.value]))
        context.on(self._lower, self._box_typed)
        context.on(self._cut, lambda: context.run("segment", "Cut out the object"))
        context.on(self._use_brush, self._say_brush)
        context.on(self._mode, lambda: None)
        context.on(self._size, lambda: None)
        context.on(self._show_correction_box, self._toggle_correction_box)
        context.on(self._box_group, self._apply_box)
        context.on(gui.add_command("Brush on or off", hotkey="B"), self._toggle_brush)
        context.on(self._clear, lambda: self._set(corrections=None))
        context.on(self._clear_points, lambda: self._set(prompts=None))

    def enter(self) -> None:
        """Take rectangles from the 3D view."""
        self._context.server.scene.on_rect_select(modifier="shift")(self._rectangle_drawn)

    def leave(self) -> None:
        """Hide what belongs to the phase alone."""
        self._context.server.scene.remove_rect_select_callback(self._rectangle_drawn)
        self._brush.deactivate()
        self._clicks.listen(False)
        self._handles.hide()
        self._correction_handles.hide()

    def refresh(self) -> None:
        """Update the source in the view, the note and the box."""
        session = self._context.session
        if session is None:
            return
        if not session.files.source_scene.is_file():
            self._note.content = note("The scene with the object is not there yet: see Open.")
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
        self._clear.disabled, self._clear_points.disabled = state.corrections is None, state.prompts is None
        self._mode.visible = self._use_brush.value
        self._show_photo()
        self._draw(session)
        self._box_group.visible = self._show_correction_box.value
        if not self._show_correction_box.value:
            self._correction_handles.hide()
        if box is not None:
            self._handles.show(box)
        else:
            self._handles.hide()
        if self._use_brush.value:
            self._brush.activate(session.scenes.gaussians(session.files.source_scene), size=float(self._size.value))
        else:
            self._brush.deactivate()
        self._clicks.listen(not self._use_brush.value)

    def view_shown(self, camera: Cameras) -> None:
        """Show which photo the view stands at."""
        self._show_photo()

    def _show_photo(self) -> None:
        cameras, photo = self._context.cameras(), self._preview.photo()
        if cameras is not None and self._photo.max != max(2, len(cameras)):
            self._photo.max = max(2, len(cameras))
        if photo is not None and self._photo.value != photo + 1:
            self._photo.value = photo + 1

    def _set_alone(self) -> None:
        self._preview.is_object_alone = self._isolate.value

    # clicks

    def _mark(self, event: viser.SceneClickEvent) -> None:
        """Add a point to the photo from whose place the scene is seen, else to the one that sees it most alike."""
        session = self._context.require_session()
        capture, photo = session.scenes.capture(session.files.source_cameras), self._preview.photo()
        if photo is not None:
            window = event.client.camera
            size = session.pictures.photo(photo)[1]
            width = max(16, window.image_width)
            pixel = PhotoView(size, (width, max(16, round(width / window.aspect)))).pixel_at(event.screen_pos)
            if pixel is None:
                raise ValueError("click: expected a place in the photo, found one beside it")
        else:
            ray = ray_from_viser(event)
            hit = first_surface_hit(self._scene(), ray.origin, ray.direction)
            if hit is None:
                raise ValueError("click: expected a surface of the scene under the pointer, found none")
            photo, pixel = seen_best(hit, ray.direction, capture.cameras)
            size = session.pictures.photo(photo)[1]
            scale = size[0] / capture.cameras[photo].width
            pixel = (pixel[0] * scale, pixel[1] * scale)
        name, on_object = capture.cameras.names[photo], self._kind.value == _CLICKS[0]
        prompts = with_click(session.state.prompts, name, pixel, on_object=on_object, longer_side=max(size))
        state, takes = replace(session.state, prompts=prompts), session.state.mask_source in _TAKES_POINTS
        session.change(state if takes else replace(state, mask_source="auto"))
        count = sum(len(p.inside) + len(p.outside) for p in (prompts or {}).values())
        clicks = "1 click" if count == 1 else f"{count} clicks"
        others = "" if takes else "; outlines are found by clicks now"
        self._context.say(f"{clicks} in {len(prompts or {})} of the photos{others}; cut out again to use them")

    def _is_read(self, session: Session) -> bool:
        """Whether the source is at hand; otherwise a sample of it is shown until it is."""
        path, scenes = session.files.source_scene, session.scenes
        if scenes.at_hand([path]):
            return True
        self._context.view.show_coarse(path, scenes.sample(path))
        self._note.content = note(scenes.reading_note(path))
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
        # without any mask or box nothing is selected yet
        if not bool(selection.any()):
            text = "Click on the object, in two or three photos; then cut it out."
        elif session.scenes.segmented() is not None:
            text = "The object is orange. Where it is wrong, click or brush, and cut it out again."
        else:
            text = "What is in the box is orange. Cut it out, or click on the object in two or three photos first."
        self._note.content = note(text, kind="selection")

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
        return self._mode.value == _STROKES[1]

    def _apply_stroke(self, touched: Tensor) -> None:
        self._correct(touched, add=self._adds())

    def _correct(self, touched: Tensor, *, add: bool) -> None:
        self._context.require_session().correct(touched, add=add)
        done = "added" if add else "removed"
        self._context.say(f"{done} what the stroke touched; cut out again to use it")


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
