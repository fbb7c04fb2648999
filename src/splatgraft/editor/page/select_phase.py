"""Select: the object in the source, from masks or a box, mended by hand. Knows nothing about how masks are lifted."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, get_args

import numpy as np
import torch
import viser

from splatgraft.editor.page.box_handles import BoxHandles
from splatgraft.editor.page.stage_view import view_of
from splatgraft.editor.picking import Rectangle, first_hit, in_brush, in_rectangle
from splatgraft.formats import read_capture
from splatgraft.segment import Box, Keep, default_box

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_SOURCES = {
    "masks beside the photos": "files",
    "a box around the object": "grabcut",
    "a network (BiRefNet)": "birefnet",
    "no masks: all that is in the box": "box",
}


_KEEP: tuple[str, ...] = get_args(Keep)


class SelectPhase:
    """The controls of the second step, and the source in 3D."""

    def __init__(self, page: Page) -> None:
        """Build them."""
        self._page, gui = page, page.gui
        self._count = gui.add_html("")
        self._source = gui.add_dropdown("Masks from", tuple(_SOURCES), initial_value=next(iter(_SOURCES)))
        self._show_box = gui.add_checkbox("Box around the object", False)
        self._lower = gui.add_vector3("Box from", (0.0, 0.0, 0.0), step=0.001, visible=False)
        self._upper = gui.add_vector3("Box to", (0.0, 0.0, 0.0), step=0.001, visible=False)
        self._keep = gui.add_dropdown("Keep pieces", _KEEP, initial_value=_KEEP[0])
        self._cut = gui.add_button("Cut out the object", icon=viser.Icon.WAND)
        with gui.add_folder("Mend by hand"):
            self._mode = gui.add_dropdown("A stroke", ("adds", "removes"), initial_value="removes")
            self._brush = gui.add_checkbox("Brush: click on the picture", False)
            self._radius = gui.add_slider(
                "Brush size", 0.01, 1.0, 0.01, 0.1, hint="Share of the distance to the object"
            )
            gui.add_markdown("Shift and drag: a rectangle.")
            self._apply_box = gui.add_button("Apply the stroke to the box", color="gray")
            self._forget = gui.add_button("Forget all strokes", icon=viser.Icon.ERASER, color="gray")
        self._isolate = gui.add_checkbox("Show the object alone", False)
        self._handles = BoxHandles(page.server, page.view, "/source/box", color=(255, 150, 40))
        self._handles.on_moved = self._box_dragged
        self._inside, self._listens = False, False
        self._connect()

    def enter(self) -> None:
        """Show the source; asked again, show it as it is now."""
        if not self._inside:
            self._page.server.scene.on_rect_select(modifier="shift")(self._rectangle)
            self._listen(self._brush.value)
        self._inside = True
        self._draw()

    def leave(self) -> None:
        """Take it away."""
        if self._inside:
            self._page.server.scene.remove_rect_select_callback(self._rectangle)
            self._listen(False)
        self._inside = False
        self._page.view.hide("/source")
        self._handles.hide()

    def refresh(self) -> None:
        """Selection, counts and box as they are now."""
        session = self._page.session
        if session is None or not self._inside:
            return
        state = session.state
        name = next((n for n, value in _SOURCES.items() if value == (state.mask_source or "files")), None)
        if name is not None:
            self._source.value = name
        self._keep.value = state.keep or _KEEP[0]
        box = session.box()
        self._show_box.value = box is not None
        self._lower.visible = self._upper.visible = self._show_box.value
        if box is not None:
            self._lower.value, self._upper.value = tuple(box.lower.tolist()), tuple(box.upper.tolist())
        if self._show_box.value and box is not None:
            self._handles.show(box)
        else:
            self._handles.hide()
        self._apply_box.disabled = not self._show_box.value
        self._forget.disabled = state.corrections is None
        self._draw()

    def _connect(self) -> None:
        act = self._page.act
        self._source.on_update(act(lambda _: self._set(mask_source=_SOURCES[self._source.value])))
        self._keep.on_update(act(lambda _: self._set(keep=self._keep.value)))
        self._show_box.on_update(act(lambda _: self._toggle_box()))
        for field in (self._lower, self._upper):
            field.on_update(act(lambda _: self._box_typed()))
        self._cut.on_click(act(lambda _: self._page.run("segment", "Cut out the object")))
        self._isolate.on_update(act(lambda _: None))
        self._brush.on_update(act(lambda _: self._toggle_brush()))
        self._apply_box.on_click(act(lambda _: self._stroke_box()))
        self._forget.on_click(act(lambda _: self._set(corrections=None)))

    def _draw(self) -> None:
        session = self._page.session
        if session is None or not session.files.source_scene.is_file():
            self._count.content = _line("There is no reconstruction yet: see step 1.")
            return
        scene, selection = session.scenes.gaussians(session.files.source_scene), session.selection()
        assert selection is not None
        self._page.view.splats("/source/object", scene, which=selection, tinted=not self._isolate.value)
        if self._isolate.value:
            self._page.view.hide("/source/rest")
        else:
            self._page.view.splats("/source/rest", scene, which=session.scenes.others("selected", selection))
        kind = "the object" if session.scenes.lifted() is not None else "inside the box"
        shown = [s for n, s in self._page.view.shown.items() if n.startswith("/source") and s.count < s.total]
        thin = f"<br>{sum(s.count for s in shown):,} are shown; files keep all" if shown else ""
        self._count.content = _line(f"<b>{int(selection.sum()):,}</b> of {scene.count:,} Gaussians are {kind}{thin}")

    def _set(self, **fields: object) -> None:
        session = self._page.need()
        session.change(replace(session.state, **fields))  # pyright: ignore[reportArgumentType]

    def _toggle_box(self) -> None:
        session = self._page.need()
        if not self._show_box.value:
            self._set(box=None)
        elif session.box() is None:
            self._set_box(self._guess())
            self._page.say("drag the two corners until the object is inside; the table stays outside")

    def _guess(self) -> Box:
        """Around what the cameras look at; where that cannot be told, the middle of the scene."""
        session = self._page.need()
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
        self._set_box(Box(torch.tensor(self._lower.value), torch.tensor(self._upper.value)))

    def _box_dragged(self, box: Box, ended: bool) -> None:
        if ended:
            self._page.act(lambda _: self._set_box(box))(None)

    def _toggle_brush(self) -> None:
        self._listen(self._brush.value)
        self._page.say("the brush is on: a click is a stroke, a drag still turns the view" if self._brush.value else "")

    def _listen(self, listen: bool) -> None:
        scene = self._page.server.scene
        if listen and not self._listens:
            scene.on_click()(self._clicked)
        if not listen and self._listens:
            scene.remove_click_callback(self._clicked)
        self._listens = listen

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        self._page.act(self._stroke_brush)(event)

    def _rectangle(self, event: viser.SceneRectSelectEvent) -> None:
        self._page.act(self._stroke_rectangle)(event)

    def _stroke_brush(self, event: viser.SceneClickEvent) -> None:
        session = self._page.need()
        scene = session.scenes.gaussians(session.files.source_scene)
        origin, direction = (
            torch.tensor(np.asarray(v), dtype=torch.float32) for v in (event.ray_origin, event.ray_direction)
        )
        hit = first_hit(scene, origin, direction)
        if hit is None:
            raise ValueError("brush: expected something solid under the click, found nothing")
        radius = float(self._radius.value) * 0.5 * float((hit - origin).norm())
        self._stroke(in_brush(scene.means, hit, radius))

    def _stroke_rectangle(self, event: viser.SceneRectSelectEvent) -> None:
        session = self._page.need()
        scene = session.scenes.gaussians(session.files.source_scene)
        camera = view_of(event.client.camera, width=1000)
        self._stroke(in_rectangle(scene.means, camera, Rectangle(event.screen_min, event.screen_max)))

    def _stroke_box(self) -> None:
        session = self._page.need()
        box = session.box()
        if box is None:
            raise ValueError("box: expected one, found none")
        self._stroke(box.contains(session.scenes.gaussians(session.files.source_scene).means))

    def _stroke(self, touched: torch.Tensor) -> None:
        add = self._mode.value == "adds"
        self._page.need().correct(touched, add=add)
        self._page.say(
            f"{'added' if add else 'removed'}: {int(touched.sum()):,} Gaussians under the stroke; cut again to use it"
        )


def _line(text: str) -> str:
    return f'<div style="font-size:.85em;line-height:1.6;padding:2px 12px">{text}</div>'
