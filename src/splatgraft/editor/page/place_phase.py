"""Place: objects in the target, by a gizmo, by numbers, by the move's name. Knows nothing about how moves are found."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import viser

from splatgraft.core.similarity import Similarity
from splatgraft.editor.access.uploads import SCENES, keep_upload
from splatgraft.editor.page.box_handles import BoxHandles
from splatgraft.editor.session import placement_moves as placing
from splatgraft.editor.session.gizmo import Gizmo, degrees_of, gizmo_of, similarity_of, wxyz_of
from splatgraft.editor.session.session import Session
from splatgraft.formats import read_gaussians
from splatgraft.formats.placement import ObjectPlacement
from splatgraft.segmentation import Box

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

NO_NAMES: tuple[str, ...] = ("1",)
"""Of a dropdown before there is anything to choose."""
_SAVE_EVERY = 0.25
"""Seconds between saves while something is dragged."""


class PlacePhase:
    """The controls of the third step, and the target with its objects in 3D."""

    def __init__(self, page: Page) -> None:
        """Build them."""
        self._page, gui = page, page.gui
        self._chosen = 0
        self._dragging = False
        self._saved = 0.0
        self._inside = False
        self._note = gui.add_html("", visible=False)
        self._suggest = gui.add_button("Find a place for it", icon=viser.Icon.WAND)
        self._which = gui.add_dropdown("Object", NO_NAMES, initial_value=NO_NAMES[0])
        self._position = gui.add_vector3("Position", (0.0, 0.0, 0.0), step=0.001)
        self._degrees = gui.add_vector3("Rotation", (0.0, 0.0, 0.0), step=0.01, hint="Degrees about x, y, z")
        self._scale = gui.add_number("Scale", 1.0, min=1e-4, step=0.001)
        self._names = gui.add_button_group("Move", ("Drop", "Upright", "Fit size"))
        self._edit = gui.add_button_group("Object ", ("Duplicate", "Delete"))
        with gui.add_folder("Another object", expand_by_default=False):
            self._path = gui.add_text("Its file", "", hint="A .ply, .spz or .splat of the object alone")
            self._add = gui.add_button("Add this file", icon=viser.Icon.PLUS, color="gray")
            self._upload = gui.add_upload_button("Upload a file", icon=viser.Icon.UPLOAD, color="gray")
        with gui.add_folder("Erase from the target", expand_by_default=False):
            self._show_box = gui.add_checkbox("Show the box", False)
            self._erase = gui.add_button("Erase what is in the box", icon=viser.Icon.ERASER, color="gray")
            self._restore = gui.add_button("Bring all back", color="gray")
        self._handles = BoxHandles(page.server, page.view, "/target/box", color=(240, 70, 70))
        self._gizmo: viser.TransformControlsHandle | None = None
        self._gizmo_size = 0.0
        self._connect()

    def enter(self) -> None:
        """Show the target and what is placed."""
        self._inside = True
        self.refresh()

    def leave(self) -> None:
        """Take it away."""
        self._inside = False
        hide_target(self._page)
        self._handles.hide()
        self._remove_gizmo()

    def refresh(self) -> None:
        """Objects, numbers and gizmo as they are now."""
        session = self._page.session
        if session is None or not self._inside:
            return
        problem = None
        if not session.files.target_scene.is_file():
            problem = "The target is not reconstructed yet: see step 1."
        elif not session.objects() and not session.files.object.is_file():
            problem = "There is no object yet: cut one out in step 2, or add one from a file."
        objects = session.objects() if session.files.target_scene.is_file() else ()
        self._note.visible, self._note.content = problem is not None, f'<div style="padding:2px 12px">{problem}</div>'
        self._suggest.visible = not objects and problem is None
        for control in (self._which, self._position, self._degrees, self._scale, self._names, self._edit):
            control.visible = bool(objects)
        if session.files.target_scene.is_file():
            show_target(self._page)
        self._chosen = max(0, min(self._chosen, len(objects) - 1))
        if objects:
            names = tuple(f"{i + 1}: {session.scenes.object_path(item).name}" for i, item in enumerate(objects))
            if tuple(self._which.options) != names:
                self._which.options = names
            self._which.value = names[self._chosen]
            if not self._dragging:
                self._show_numbers(self._current())
                self._show_gizmo(session, self._current())
        else:
            self._remove_gizmo()
        if not self._show_box.value:
            self._handles.hide()
        self._erase.disabled = not self._show_box.value
        self._restore.disabled = session.state.erased is None

    def _connect(self) -> None:
        act = self._page.act
        self._suggest.on_click(act(lambda _: self._find_place()))
        self._which.on_update(act(lambda _: self._choose()))
        for control in (self._position, self._degrees, self._scale):
            control.on_update(act(lambda _: self._typed()))
        self._names.on_click(act(lambda event: self._named(event.target.value)))
        self._edit.on_click(
            act(lambda event: self._duplicate() if event.target.value == "Duplicate" else self._delete())
        )
        self._add.on_click(act(lambda _: self._add_file(self._page.allowed(self._path.value))))
        self._upload.on_upload(act(self._uploaded))
        self._show_box.on_update(act(lambda _: self._toggle_box()))
        self._erase.on_click(act(lambda _: self._erase_box()))
        self._restore.on_click(act(lambda _: self._bring_back()))
        gui = self._page.gui
        drop = gui.add_command("Drop to the surface", hotkey="G")
        duplicate = gui.add_command("Duplicate the object", hotkey="D")
        delete = gui.add_command("Delete the object", hotkey="delete")
        drop.on_trigger(act(lambda _: self._named("Drop") if self._inside else None))
        duplicate.on_trigger(act(lambda _: self._duplicate() if self._inside else None))
        delete.on_trigger(act(lambda _: self._delete() if self._inside else None))

    # moves

    def _current(self) -> Gizmo:
        session = self._page.need()
        item = session.objects()[self._chosen]
        return gizmo_of(item.target_from_object, session.placeable(self._chosen).base.point)

    def _move(self, move: Similarity) -> None:
        self._page.need().move(self._chosen, move)

    def _typed(self) -> None:
        session = self._page.need()
        gizmo = Gizmo(self._position.value, wxyz_of(self._degrees.value), float(self._scale.value))
        self._move(similarity_of(gizmo, session.placeable(self._chosen).base.point))

    def _named(self, name: str) -> None:
        session = self._page.need()
        item, move = session.placeable(self._chosen), session.objects()[self._chosen].target_from_object
        target, up = session.scenes.composite(session.placed_state()).target, session.up()
        cameras = session.scenes.cameras(session.files.target_cameras)
        if name == "Drop":
            self._move(placing.dropped(target, item, move, up=up))
            self._page.say("dropped: it stands upright on the surface below it")
        elif name == "Upright":
            self._move(placing.upright(item, move, up=up))
        else:
            scale = placing.plausible_scale(target, item, move, cameras)
            self._move(placing.resized(item, move, scale))
            self._page.say("a size that fills about a third of the views' height; captures have no common unit")

    def _find_place(self) -> None:
        session = self._page.need()
        item = session.scenes.placeable(ObjectPlacement(Similarity.identity()))
        cameras = session.scenes.cameras(session.files.target_cameras)
        move = placing.suggested(
            session.scenes.gaussians(session.files.target_scene), item, cameras, session.files.placing
        )
        session.change(replace(session.state, objects=(ObjectPlacement(move),)))
        self._page.say("placed where it is level and in view; drag it, or type numbers")

    def _choose(self) -> None:
        self._chosen = list(self._which.options).index(self._which.value)
        self._remove_gizmo()

    def _duplicate(self) -> None:
        session = self._page.need()
        item = session.objects()[self._chosen]
        move = placing.beside(session.placeable(self._chosen), item.target_from_object, up=session.up())
        objects = (*session.objects(), replace(item, target_from_object=move))
        session.change(replace(session.state, objects=objects))
        self._chosen = len(objects) - 1
        self._remove_gizmo()

    def _delete(self) -> None:
        session = self._page.need()
        objects = session.objects()
        if objects:
            rest = (*objects[: self._chosen], *objects[self._chosen + 1 :])
            session.change(replace(session.state, objects=rest))
            self._remove_gizmo()

    def _uploaded(self, event: viser.GuiEvent) -> None:
        file, root = event.target.value, self._page.need().files.file.parent
        self._add_file(keep_upload(root, file.name, file.content, suffixes=SCENES))

    def _add_file(self, path: Path) -> None:
        session = self._page.need()
        read_gaussians(path)
        item = session.scenes.placeable(ObjectPlacement(Similarity.identity(), path))
        cameras = session.scenes.cameras(session.files.target_cameras)
        # what is placed already counts as a part of the scene
        scene = session.scenes.composite(session.placed_state()).merged()[0]
        move = placing.suggested(scene, item, cameras)
        objects = (*session.objects(), ObjectPlacement(move, path))
        session.change(replace(session.state, objects=objects))
        self._chosen = len(objects) - 1
        self._remove_gizmo()

    # erasing

    def _toggle_box(self) -> None:
        if not self._show_box.value:
            return
        session = self._page.need()
        objects = session.objects()
        centre = torch.tensor(self._current().position) if objects else self._middle(session)
        half = 0.25 * self._page.reach()
        self._handles.show(Box(centre - half, centre + half))

    def _erase_box(self) -> None:
        session, box = self._page.need(), self._handles.box
        if box is None:
            raise ValueError("box: expected one in view, found none")
        inside = box.contains(session.scenes.gaussians(session.files.target_scene).means)
        before = session.state.erased
        erased = inside if before is None else before | inside
        session.change(replace(session.placed_state(), erased=erased))
        self._page.say(f"erased: {int(inside.sum()):,} Gaussians of the target")

    def _bring_back(self) -> None:
        session = self._page.need()
        session.change(replace(session.placed_state(), erased=None))

    def _middle(self, session: Session) -> torch.Tensor:
        return session.scenes.gaussians(session.files.target_scene).means.median(0).values

    # the gizmo

    def _show_numbers(self, gizmo: Gizmo) -> None:
        self._position.value = gizmo.position
        # no -0 and no trailing digits of rounding; what is typed counts exactly
        x, y, z = (round(angle, 2) + 0.0 for angle in degrees_of(gizmo.wxyz))
        self._degrees.value = (x, y, z)
        self._scale.value = gizmo.scale

    def _show_gizmo(self, session: Session, gizmo: Gizmo) -> None:
        base = session.placeable(self._chosen).base
        # splats are drawn over it: it must reach out of the object
        size = 1.6 * gizmo.scale * max(base.height, base.radius)
        if self._gizmo is None or abs(size - self._gizmo_size) > 0.05 * size:
            self._remove_gizmo()
            self._gizmo_size = size
            self._gizmo = self._page.server.scene.add_transform_controls(
                "/gizmo", scale=size, line_width=4.0, position=gizmo.position, wxyz=gizmo.wxyz
            )
            self._gizmo.on_update(self._dragged)
            return
        self._gizmo.position, self._gizmo.wxyz = np.array(gizmo.position), np.array(gizmo.wxyz)

    def _remove_gizmo(self) -> None:
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None

    async def _dragged(self, event: viser.TransformControlsEvent) -> None:
        session, handle = self._page.session, self._gizmo
        if session is None or handle is None or self._chosen >= len(session.objects()):
            return
        if event.phase == "start":
            return
        pose, wxyz = np.asarray(handle.position).tolist(), np.asarray(handle.wxyz).tolist()
        before = session.objects()[self._chosen]
        gizmo = Gizmo((pose[0], pose[1], pose[2]), (wxyz[0], *wxyz[1:]), before.target_from_object.scale)
        move = similarity_of(gizmo, session.placeable(self._chosen).base.point)
        self._page.view.move(f"/target/objects/{self._chosen}", move)
        after = session.placed_state().with_object(self._chosen, replace(before, target_from_object=move))
        ended, now = event.phase == "end", time.monotonic()
        # a drag is one step of history, saved while it goes on
        if not self._dragging:
            self._dragging, self._saved = True, now
            self._page.act(lambda _: session.change(after))(None)
        elif ended or now - self._saved > _SAVE_EVERY:
            self._saved = now
            session.amend(after)
        self._page.preview.moving(None if ended else after)
        if ended:
            self._dragging = False
            self._page.refresh()


def show_target(page: Page) -> None:
    """The target and what is placed in it, in 3D."""
    session = page.need()
    state, view = session.placed_state(), page.view
    target = session.scenes.gaussians(session.files.target_scene)
    kept = None if state.erased is None else session.scenes.others("erased", state.erased)
    view.splats("/target/scene", target, which=kept)
    objects = state.objects or ()
    for index, item in enumerate(objects):
        gaussians = session.scenes.gaussians(session.scenes.object_path(item))
        view.splats(f"/target/objects/{index}", gaussians, move=item.target_from_object)
    for name in [n for n in view.shown if n.startswith("/target/objects/") and int(n.split("/")[-1]) >= len(objects)]:
        view.drop(name)


def hide_target(page: Page) -> None:
    """Take it away."""
    page.view.hide("/target")
