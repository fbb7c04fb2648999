"""The step `Select`: select the object by clicks in photos or in the scene, by masks or a box, and by a brush."""

from dataclasses import replace
from functools import partial
from typing import Any, get_args

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.editor.form import Form
from splatgraft.editor.panel import CORNERS, Panel, Pointer, box_over
from splatgraft.editor.photo_view import PhotoView, prompt_of, seen_best, with_click
from splatgraft.editor.picking import Ray, brush_selection, in_rectangle, interpolate_rays
from splatgraft.editor.state import EditState
from splatgraft.editor.stream import View
from splatgraft.segmentation import Box, Keep, default_box

_SOURCES = {
    "masks beside the photos, else cut from them": "auto",
    "masks beside the photos": "files",
    "clicks, or a box around the object": "grabcut",
    "a network (BiRefNet)": "birefnet",
    "no masks: everything inside the box": "box",
}
_KEEP: dict[str, Keep] = {"all large pieces": "substantial", "only the largest piece": "largest", "all pieces": "all"}
_TAKES_POINTS = (None, "auto", "grabcut", "sam2")
"""Values of `mask_source` that use clicks."""
_GREEN, _RED, _ORANGE = "#3cdc5a", "#eb283c", "#ff9628"


class SelectPanel(Panel):
    """Controls of the selection, and the source in the view."""

    _marks_object, _uses_brush, _adds, _is_alone = True, False, False, False
    _brush_size = 0.1
    _last: Ray | None = None
    """Last ray of a stroke."""
    _touched: Tensor | None = None
    """Gaussians that the stroke touches."""

    def leave(self) -> None:
        """Switch the brush off."""
        super().leave()
        self._uses_brush, self._last, self._touched = False, None, None

    def build(self, form: Form) -> None:
        """Add the controls."""
        editor, session = self.editor, self.session
        if not session.files.scenes["source"].is_file():
            form.note("The scene with the object is not there yet: see Open.")
            return
        state, selection = session.state, session.selection()
        form.note(self._said(bool(selection is not None and selection.any())), name="selection")
        masks = [path.name for path in session.scenes.missing_masks()]
        more = f" and {len(masks) - 3} more" if len(masks) > 3 else ""
        form.note(f"Missing masks: {', '.join(masks[:3])}{more}." if masks else "", name="warning", bad=True)
        marks, hint = {"the object": True, "what is beside it": False}, "Alt or the right button: what is beside it"
        form.choice("marks", "A click marks", self._marks_object, marks, self._sets("_marks_object"), hint=hint)
        editor.add_photos(form)
        form.button("cut", "Cut out the object", lambda: editor.run("segment", "Cut out the object"), main=True)
        hint = "Drag over the picture (B); Shift and drag: a rectangle"
        form.check("brush", "Brush", self._uses_brush, self._use_brush, hint=hint)
        if self._uses_brush:
            strokes = {"removes": False, "adds": True}
            form.choice("stroke", "The brush", self._adds, strokes, self._sets("_adds"))
        form.check("alone", "Object alone", self._is_alone, self._sets("_is_alone"))
        form.more()
        for name, label, field in (("no_clicks", "clicks", "prompts"), ("no_strokes", "strokes", "corrections")):
            forget = partial(self._set, **{field: None})
            form.button(name, f"Forget all {label}", forget, disabled=getattr(state, field) is None)
        sizes, hint = (0.01, 0.5, 0.01), "Over the distance to the surface"
        form.slider("brush_size", "Brush size", self._brush_size, sizes, self._sets("_brush_size"), hint=hint)
        source, keep = state.mask_source or "auto", state.keep or get_args(Keep)[0]
        form.choice("outlines", "Outlines from", source, _SOURCES, lambda value: self._set(mask_source=value))
        form.choice("keep", "Keep", keep, _KEEP, lambda value: self._set(keep=value))
        form.check("box", "Box around the object", state.box is not None, self._toggle_box)
        if state.box is not None:
            lower, upper = state.box[:3], state.box[3:]
            form.numbers("box_from", "Box from", lower, lambda v: self._set(box=(*v, *upper)))
            form.numbers("box_to", "Box to", upper, lambda v: self._set(box=(*lower, *v)))

    def _said(self, is_any: bool) -> str:
        if not is_any:
            return "Click on the object, in two or three photos; then cut it out."
        if self.session.scenes.segmented() is not None:
            return "The object is orange. Where it is wrong, click or brush, and cut it out again."
        return "What is in the box is orange. Cut it out, or click on the object in two or three photos first."

    def tools(self) -> dict[str, Any]:
        """Offer strokes of the brush, and rectangles."""
        return {"paint": self._uses_brush, "rectangle": True}

    # the picture

    def picture(self, view: View, camera: Cameras) -> tuple[UInt8[np.ndarray, "h w 3"], str]:
        """Draw the source, or a photo of it, with the selection."""
        which = self.session.selection()
        if self._touched is not None and which is not None:
            which = which | self._touched if self._adds else which & ~self._touched
        return self.session.pictures.draw_source(which, camera, photo=view.photo, alone=self._is_alone), "full quality"

    def overlay(self, view: View, camera: Cameras) -> dict[str, Any]:
        """Describe the clicks and their outline in a photo, or the box elsewhere."""
        session, photo = self.session, view.photo  # another thread may turn the view away from the photo
        if photo is None:
            box = session.box()
            return {"dots": [], "lines": []} if box is None else box_over(box, camera, _ORANGE)
        name = session.scenes.cameras("source").names[photo]
        prompt, (width, height) = prompt_of(session.state.prompts, name), session.pictures.source_photo(photo)[1]
        shown, dots = PhotoView((width, height), (camera.width, camera.height)), []
        for points, color in ((prompt.inside, _GREEN), (prompt.outside, _RED)):
            at = [shown.place_of(x / width, y / height) for x, y in points.tolist()]
            dots += [{"at": [round(x, 4), round(y, 4)], "color": color} for x, y in at]
        outline = [[shown.place_of(*point) for point in line] for line in self._outline(photo)]
        return {"dots": dots, "lines": [{"points": one, "color": _GREEN, "closed": True} for one in outline]}

    def _outline(self, photo: int) -> list[list[tuple[float, float]]]:
        """Return the outline in a photo; start its computation if it is not known yet."""
        state = self.session.state
        if not state.prompts or state.mask_source not in _TAKES_POINTS:
            return []
        found = self.session.scenes.derive("outlines by photo", (state.prompts,), dict)
        if photo not in found:
            found[photo] = []
            self.editor.background.submit(partial(self._find_outline, state, photo, found))
        return found[photo]

    def _find_outline(self, state: EditState, photo: int, found: dict[int, Any]) -> None:
        found[photo] = self.session.pictures.outline(state, photo)
        self.editor.stream.touch()

    # the pointer

    def pointer(self, view: View, pointer: Pointer) -> None:
        """Handle clicks, strokes, rectangles and drags of the box."""
        if pointer.what == "rectangle":
            means = self.session.scenes.scene("source").means
            inside = in_rectangle(means, self.camera(view), pointer.place, pointer.to)
            self._correct(inside, add=self._adds != pointer.alt)
        elif pointer.on in CORNERS:
            found = self.dragged_box(view, pointer, self.session.box())
            if found is not None and pointer.what == "up":
                self._set_box(found)
        elif self._uses_brush:
            self._paint(view, pointer)
        elif pointer.what == "click":
            self._mark(view, pointer)

    def _mark(self, view: View, pointer: Pointer) -> None:
        """Add a point to the photo in view, or to the one with the most similar direction, and show it."""
        session, pictures = self.session, self.session.pictures
        cameras, photo = session.scenes.cameras("source"), view.photo
        if photo is not None:
            size = pictures.source_photo(photo)[1]
            pixel = PhotoView(size, view.canvas).pixel_at(pointer.place)
            if pixel is None:
                raise ValueError("Click in the photo, not beside it.")
        else:
            hit, ray = self.surface_under(pointer, view, self.session.scenes.scene("source"))
            photo, pixel = seen_best(hit, ray.direction, cameras)
            size = pictures.source_photo(photo)[1]
            scale = size[0] / cameras[photo].width
            pixel = (pixel[0] * scale, pixel[1] * scale)
            self.editor.to_photo(photo)
        on_object = self._marks_object != pointer.alt
        prompts = with_click(
            session.state.prompts, cameras.names[photo], pixel, on_object=on_object, longer_side=max(size)
        )
        state, takes = replace(session.state, prompts=prompts), session.state.mask_source in _TAKES_POINTS
        session.change(state if takes else replace(state, mask_source="auto"))
        count = sum(len(p.inside) + len(p.outside) for p in (prompts or {}).values())
        clicks = "1 click" if count == 1 else f"{count} clicks"
        others = "" if takes else "; outlines are found by clicks now"
        self.editor.say(f"{clicks} in {len(prompts or {})} of the photos{others}. {self._again('them')}")

    # the brush

    def _use_brush(self, value: bool) -> None:
        self._uses_brush = value
        view = self.editor.editing()
        if value and view is not None and view.photo is not None:
            view.photo = None  # the brush paints on the scene
        on = "the brush is on: drag or click in the view; B switches it off, so that a drag rotates the view again"
        self.editor.say(on if value else "the brush is off")

    def _paint(self, view: View, pointer: Pointer) -> None:
        ray, scene = Ray.through(pointer.place, self.camera(view)), self.session.scenes.scene("source")
        if pointer.what in ("down", "click"):
            self._touched = torch.zeros(scene.count, dtype=torch.bool)
            new = [ray]
        elif self._touched is None or self._last is None:
            return
        else:
            new = interpolate_rays(self._last, ray, size=self._brush_size)
        self._last = ray
        if pointer.what == "cancel":
            self._touched = None
            return
        assert self._touched is not None
        self._touched = self._touched | brush_selection(scene, new, size=self._brush_size)
        self.editor.stream.touch(moving=True)
        if pointer.what in ("up", "click"):
            touched, self._touched = self._touched, None
            if not bool(touched.any()):
                raise ValueError("There is no surface under the stroke.")
            self._correct(touched, add=self._adds != pointer.alt)

    def _correct(self, touched: Tensor, *, add: bool) -> None:
        self.session.correct(touched, add=add)
        self.editor.say(f"{'added' if add else 'removed'} what the stroke touched. {self._again('it')}")

    def _again(self, what: str) -> str:
        """Return the sentence that names the button which uses new clicks or strokes (`what`)."""
        return "Press Cut out." if self.session.scenes.segmented() is None else f"Cut out again to use {what}."

    def key(self, view: View, key: str) -> bool:
        """Switch the brush on or off on B."""
        if key == "b":
            self._use_brush(not self._uses_brush)
        return key == "b"

    # the box

    def _toggle_box(self, value: bool) -> None:
        if not value:
            self._set(box=None)
        elif self.session.box() is None:
            self._set_box(self._default_box())
            self.editor.say(
                "leave the photo by dragging the view; then drag the two corners until the box holds the object"
            )

    def _default_box(self) -> Box:
        """Return the box around the cameras' focus, or the middle half of the scene if there is no capture."""
        session = self.session
        try:
            return default_box(session.scenes.capture())
        except ValueError:
            lower, upper = self.session.scenes.scene("source").means.quantile(torch.tensor([0.25, 0.75]), 0)
            return Box(lower, torch.maximum(upper, lower + 1e-6))

    def _set_box(self, box: Box) -> None:
        self._set(box=tuple(round(x, 6) for x in (*box.lower.tolist(), *box.upper.tolist())))

    def _set(self, **fields: object) -> None:
        session = self.session
        session.change(replace(session.state, **fields))  # pyright: ignore[reportArgumentType]
