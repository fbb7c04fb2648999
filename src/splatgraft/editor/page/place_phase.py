"""The phase `Place`: place objects in the target by gizmo, numbers and named operations; erase parts of the target."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
import viser

from splatgraft.core.similarity import Similarity
from splatgraft.editor.page.box_handles import BoxHandles
from splatgraft.editor.page.object_gizmo import SNAP_DEGREES, ObjectGizmo
from splatgraft.editor.page.size_controls import SizeControls
from splatgraft.editor.session import placement_operations
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.gizmo import (
    Gizmo,
    degrees_from_quaternion,
    gizmo_from_similarity,
    quaternion_from_degrees,
    similarity_from_gizmo,
)
from splatgraft.editor.session.object_size import true_scale
from splatgraft.editor.session.session import Session
from splatgraft.editor.session.state_checks import check_numbers, check_state
from splatgraft.editor.uploads.upload_checks import SCENES
from splatgraft.formats import read_gaussians
from splatgraft.formats.placement import ObjectPlacement
from splatgraft.segmentation import Box

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

NO_NAMES: tuple[str, ...] = ("1",)
"""Options of a dropdown while there is nothing to choose."""
_SAVE_EVERY = 0.25
"""Seconds between saves during a drag."""
_SNAP_NEAR = 0.5
"""Distance from the surface, over the object's height, within which a drag ends on it."""


class PlacePhase:
    """The controls of the phase, and the target with its objects in the 3D view."""

    def __init__(self, page: Page) -> None:
        """Build the controls."""
        self._page, gui = page, page.gui
        self._chosen = 0
        self._dragging = False
        self._shown: Gizmo | None = None
        """What the fields of numbers show; as `SelectPhase._shown_box`."""
        self._saved = 0.0
        self._is_active = False
        self._note = gui.add_html("", visible=False)
        self._suggest = gui.add_button("Find a place", icon=viser.Icon.WAND)
        self._object_choice = gui.add_dropdown("Object", NO_NAMES, initial_value=NO_NAMES[0])
        self._position = gui.add_vector3("Position", (0.0, 0.0, 0.0), step=0.001)
        self._degrees = gui.add_vector3("Rotation", (0.0, 0.0, 0.0), step=0.01, hint="Degrees about x, y, z")
        self._scale = gui.add_number("Scale", 1.0, min=1e-4, step=0.001)
        self._size = SizeControls(page)
        self._operations = gui.add_button_group("Move", ("Drop", "Upright", "Fit size"))
        self._snap = gui.add_checkbox(
            "Snap",
            False,
            hint=f"A drag turns in steps of {SNAP_DEGREES:.0f} degrees and ends on a near surface (key S)",
        )
        self._object_buttons = gui.add_button_group("Object ", ("Duplicate", "Delete"))
        with gui.add_folder("Another object", expand_by_default=False):
            self._path = gui.add_text("File", "", hint="A trained scene (.ply, .spz, .sog, ...) of the object alone")
            self._add = gui.add_button("Add this file", icon=viser.Icon.PLUS, color="gray")
            page.uploads.add("Upload a file", SCENES, self._add_file)
        with gui.add_folder("Erase from the target", expand_by_default=False):
            self._show_box = gui.add_checkbox("Show the box", False)
            self._erase = gui.add_button("Erase inside the box", icon=viser.Icon.ERASER, color="gray")
            self._restore = gui.add_button("Restore all erased", color="gray")
        self._handles = BoxHandles(page.server, page.view, "/target/box", color=(240, 70, 70))
        self._gizmo = ObjectGizmo(page.server, self._dragged)
        self._connect()

    def enter(self) -> None:
        """Show the target and the placed objects."""
        self._is_active = True
        self.refresh()

    def leave(self) -> None:
        """Hide them."""
        self._is_active = False
        hide_target(self._page)
        self._handles.hide()
        self._gizmo.remove()

    def refresh(self) -> None:
        """Update the list of objects, the numbers and the gizmo."""
        session = self._page.session
        if session is None or not self._is_active:
            return
        problem = None
        if not session.files.target_scene.is_file():
            problem = "The target is not reconstructed yet: see Open."
        elif not session.objects() and not session.files.object.is_file():
            problem = "There is no object yet: cut one out in Select, or add one from a file."
        objects = session.objects() if session.files.target_scene.is_file() else ()
        self._suggest.visible = not objects and problem is None
        if session.files.target_scene.is_file() and not show_target(self._page):
            problem = problem or session.scenes.reading_note(session.files.target_scene)
        self._note.visible, self._note.content = problem is not None, f'<div style="padding:2px 12px">{problem}</div>'
        is_usable = bool(objects) and self._page.loading.has(session, session.scenes.base_files(objects))
        for control in (
            self._object_choice,
            self._position,
            self._degrees,
            self._scale,
            self._operations,
            self._snap,
            self._object_buttons,
        ):
            control.visible = is_usable
        self._chosen = max(0, min(self._chosen, len(objects) - 1))
        if is_usable:
            names = tuple(f"{i + 1}: {session.scenes.object_path(item).name}" for i, item in enumerate(objects))
            if tuple(self._object_choice.options) != names:
                self._object_choice.options = names
            self._object_choice.value = names[self._chosen]
            if not self._dragging:
                self._show_numbers(self._current())
                self._gizmo.snaps = self._snap.value
                item = session.placeable_object(self._chosen)
                self._gizmo.show(item, objects[self._chosen].target_from_object)
                self._size.show(self._chosen)
        else:
            self._size.hide()
            self._gizmo.remove()
        if not self._show_box.value:
            self._handles.hide()
        self._erase.disabled = not self._show_box.value
        self._restore.disabled = session.state.erased is None

    def _connect(self) -> None:
        callback = self._page.callback
        self._suggest.on_click(callback(lambda _: self._find_place()))
        self._object_choice.on_update(callback(lambda _: self._choose()))
        for control in (self._position, self._degrees, self._scale):
            control.on_update(callback(lambda _: self._numbers_changed()))
        self._operations.on_click(callback(lambda event: self._apply_operation(event.target.value)))
        self._object_buttons.on_click(
            callback(lambda event: self._duplicate() if event.target.value == "Duplicate" else self._delete())
        )
        self._add.on_click(callback(lambda _: self._add_file(self._page.parse_path(self._path.value))))
        self._show_box.on_update(callback(lambda _: self._toggle_box()))
        self._erase.on_click(callback(lambda _: self._erase_box()))
        self._restore.on_click(callback(lambda _: self._restore_all()))
        gui = self._page.gui
        drop = gui.add_command("Drop to the surface", hotkey="G")
        duplicate = gui.add_command("Duplicate the object", hotkey="D")
        delete = gui.add_command("Delete the object", hotkey="delete")
        snap = gui.add_command("Snap on or off", hotkey="S")
        snap.on_trigger(callback(lambda _: self._toggle_snap() if self._is_active else None))
        drop.on_trigger(callback(lambda _: self._apply_operation("Drop") if self._is_active else None))
        duplicate.on_trigger(callback(lambda _: self._duplicate() if self._is_active else None))
        delete.on_trigger(callback(lambda _: self._delete() if self._is_active else None))

    def _toggle_snap(self) -> None:
        self._snap.value = not self._snap.value

    # placement

    def _current(self) -> Gizmo:
        session = self._page.require_session()
        item = session.objects()[self._chosen]
        return gizmo_from_similarity(item.target_from_object, session.placeable_object(self._chosen).base.point)

    def _set_placement(self, target_from_object: Similarity) -> None:
        self._page.require_session().set_placement(self._chosen, target_from_object)

    def _numbers_changed(self) -> None:
        session = self._page.require_session()
        self._shown = None  # so that the fields go back to the state where these numbers are refused
        check_numbers((*self._position.value, *self._degrees.value, self._scale.value), "position, rotation, scale")
        gizmo = Gizmo(self._position.value, quaternion_from_degrees(self._degrees.value), float(self._scale.value))
        self._set_placement(similarity_from_gizmo(gizmo, session.placeable_object(self._chosen).base.point))
        self._shown = self._current()

    def _apply_operation(self, name: str) -> None:
        session = self._page.require_session()
        item, placed = session.placeable_object(self._chosen), session.objects()[self._chosen].target_from_object
        target, up = session.scenes.composite(session.placed_state()).target, session.up()
        cameras = session.scenes.cameras(session.files.target_cameras)
        if name == "Drop":
            self._set_placement(placement_operations.drop_to_surface(target, item, placed, up=up))
            self._page.say("dropped: it stands upright on the surface below")
        elif name == "Upright":
            self._set_placement(placement_operations.align_up(item, placed, up=up))
        else:
            scale = placement_operations.plausible_scale(target, item, placed, cameras)
            self._set_placement(placement_operations.rescale(item, placed, scale))
            self._page.say("scaled to about a third of the views' height, which is a guess")

    def _find_place(self) -> None:
        session = self._page.require_session()
        item = session.scenes.placeable_object(ObjectPlacement(Similarity.identity()))
        cameras = session.scenes.cameras(session.files.target_cameras)
        options = session.files.place_options
        # as `compose` does
        options = replace(options, scale=true_scale(session)) if options.scale is None else options
        placed = placement_operations.suggest_placement(
            session.scenes.gaussians(session.files.target_scene), item, cameras, options
        )
        session.change(replace(session.state, objects=(ObjectPlacement(placed),)))
        self._page.say("placed on a level, visible surface; drag it, or type numbers")

    def _choose(self) -> None:
        self._chosen = list(self._object_choice.options).index(self._object_choice.value)
        self._gizmo.remove()

    def _duplicate(self) -> None:
        session = self._page.require_session()
        item = session.objects()[self._chosen]
        # objects that are placed already count as part of the scene
        scene = session.scenes.composite(session.placed_state()).merged()[0]
        placed, is_supported = placement_operations.place_beside(
            scene, session.placeable_object(self._chosen), item.target_from_object, up=session.up()
        )
        objects = (*session.objects(), replace(item, target_from_object=placed))
        session.change(replace(session.state, objects=objects))
        self._chosen = len(objects) - 1
        self._gizmo.remove()
        if not is_supported:
            self._page.say("duplicated; no surface at this height was found beside it: move it, then Drop", bad=True)

    def _delete(self) -> None:
        session = self._page.require_session()
        objects = session.objects()
        if objects:
            rest = (*objects[: self._chosen], *objects[self._chosen + 1 :])
            session.change(replace(session.state, objects=rest))
            self._gizmo.remove()

    def _add_file(self, path: Path) -> None:
        session = self._page.require_session()
        read_gaussians(path)
        item = session.scenes.placeable_object(ObjectPlacement(Similarity.identity(), path))
        cameras = session.scenes.cameras(session.files.target_cameras)
        # objects that are placed already count as part of the scene
        scene = session.scenes.composite(session.placed_state()).merged()[0]
        placed = placement_operations.suggest_placement(scene, item, cameras)
        objects = (*session.objects(), ObjectPlacement(placed, path))
        session.change(replace(session.state, objects=objects))
        self._chosen = len(objects) - 1
        self._gizmo.remove()

    # erase

    def _toggle_box(self) -> None:
        if not self._show_box.value:
            return
        session = self._page.require_session()
        objects = session.objects()
        centre = torch.tensor(self._current().position) if objects else self._middle(session)
        half = 0.25 * self._page.scene_scale()
        self._handles.show(Box(centre - half, centre + half))

    def _erase_box(self) -> None:
        session, box = self._page.require_session(), self._handles.box
        if box is None:
            raise ValueError("box: expected one in view, found none")
        inside = box.contains(session.scenes.gaussians(session.files.target_scene).means)
        erased_before = session.state.erased
        erased = inside if erased_before is None else erased_before | inside
        session.change(replace(session.placed_state(), erased=erased))
        self._page.say(f"erased: {int(inside.sum()):,} Gaussians of the target")

    def _restore_all(self) -> None:
        session = self._page.require_session()
        session.change(replace(session.placed_state(), erased=None))

    def _middle(self, session: Session) -> torch.Tensor:
        return session.scenes.gaussians(session.files.target_scene).means.median(0).values

    # the gizmo

    def _show_numbers(self, gizmo: Gizmo) -> None:
        if gizmo == self._shown:
            return
        self._shown = gizmo
        self._position.value = gizmo.position
        # rounded for display, without -0; typed numbers are used exactly
        x, y, z = (round(angle, 2) + 0.0 for angle in degrees_from_quaternion(gizmo.wxyz))
        self._degrees.value = (x, y, z)
        self._scale.value = gizmo.scale

    def _dragged(self, placed: Similarity, ended: bool) -> None:
        """Show and save a placement during a drag; a drag is one undo step and is saved repeatedly while it lasts."""
        session = self._page.session
        if session is None or self._chosen >= len(session.objects()):
            return
        with self._page.reported():
            if ended and self._snap.value:
                placed = self._snapped_to_surface(session, placed)
            item = session.objects()[self._chosen]
            self._page.view.set_transform(f"/target/objects/{self._chosen}", placed)
            edited = session.placed_state().with_object(self._chosen, replace(item, target_from_object=placed))
            check_state(edited)
            now = time.monotonic()
            if not self._dragging:
                self._dragging, self._saved = True, now
                self._page.callback(lambda _: session.change(edited))(None)
            elif ended or now - self._saved > _SAVE_EVERY:
                self._saved = now
                session.amend(edited)
            self._page.preview.set_dragged_state(None if ended else edited)
        if ended:
            self._dragging = False
            self._page.preview.set_dragged_state(None)
            self._page.refresh()

    def _snapped_to_surface(self, session: Session, placed: Similarity) -> Similarity:
        """The placement with its foot on the surface below or just above, where there is one near."""
        item, up = session.placeable_object(self._chosen), session.up()
        target = session.scenes.composite(session.placed_state()).target
        try:
            fallen = placement_operations.drop_to_surface(target, item, placed, up=up)
        except ValueError:
            return placed
        rise = float((fallen.points(item.base.point) - placed.points(item.base.point)) @ up)
        near = _SNAP_NEAR * placed.scale * item.base.height
        return replace(placed, translation=placed.translation + rise * up) if abs(rise) < near else placed


def show_target(page: Page) -> bool:
    """Show the target and the placed objects in the 3D view, or a sample of a target that is being read.

    Returns:
        Whether all of them are shown.
    """
    session = page.require_session()
    state, view, path = session.placed_state(), page.view, session.files.target_scene
    objects = state.objects or ()
    if page.loading.has(session, [path]):
        _show_kept(page, session, state)
        view.remove_coarse()
    elif not view.is_shown("/target/scene"):
        sample = session.scenes.sample(path)
        flags = None if state.erased is None else state.erased.numpy()
        view.show_coarse(path, sample if flags is None or sample is None else sample.without(flags))
    for index, item in enumerate(objects):
        if page.loading.has(session, [session.scenes.object_path(item)]):
            gaussians = session.scenes.gaussians(session.scenes.object_path(item))
            view.show_splats(f"/target/objects/{index}", gaussians, transform=item.target_from_object)
    for name in [n for n in view.shown if n.startswith("/target/objects/") and int(n.split("/")[-1]) >= len(objects)]:
        view.remove_splats(name)
    return page.loading.has(session, session.placed_scenes())


def _show_kept(page: Page, session: Session, state: EditState) -> None:
    """The target without its erased Gaussians."""
    target = session.scenes.gaussians(session.files.target_scene)
    if state.erased is not None and len(state.erased) != target.count:
        raise ValueError(
            f"erased.npy: expected one flag per Gaussian of the target, {target.count:,}; found {len(state.erased):,}; "
            "restore all erased, or undo"
        )
    shown = None if state.erased is None else session.scenes.complement("erased", state.erased)
    page.view.show_splats("/target/scene", target, which=shown)


def hide_target(page: Page) -> None:
    """Hide them."""
    page.view.hide_splats("/target")
