"""The phase `Place`: place objects in the target by gizmo, numbers and named operations; erase parts of the target."""

import html
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import viser

from splatgraft.core.cameras import Cameras
from splatgraft.core.similarity import Similarity
from splatgraft.editor.grab import GrabMode, Point2
from splatgraft.editor.page.context import PageContext, Phase, note, parse_path
from splatgraft.editor.page.handles import SNAP_DEGREES, BoxHandles, ObjectGizmo
from splatgraft.editor.page.hands import ObjectHands
from splatgraft.editor.page.preview_panel import PreviewPanel
from splatgraft.editor.page.scene_view import direction_from_viser
from splatgraft.editor.placement import (
    Gizmo,
    ObjectSize,
    align_up,
    degrees_from_quaternion,
    drop_to_surface,
    gizmo_from_similarity,
    place_beside,
    plausible_scale,
    quaternion_from_degrees,
    rescale,
    similarity_from_gizmo,
    snapped_angles,
    suggest_placement,
)
from splatgraft.editor.session import Session
from splatgraft.editor.sky_dome import SkyDome
from splatgraft.editor.state import check_numbers, check_state
from splatgraft.formats import SCENE_SUFFIXES, read_gaussians
from splatgraft.project.placement import ObjectPlacement
from splatgraft.segmentation import Box

_NO_NAMES: tuple[str, ...] = ("1",)
"""Options of a dropdown while there is nothing to choose."""
_SNAP_NEAR = 0.5
"""Distance from the surface, over the object's height, within which a drag ends on it."""
_NUDGE = 0.05
"""Step of an arrow key over the object's height."""
_SCALES = ("its photos", "the place")
_SAME = 0.002
"""Relative difference below which two sizes count as one."""


class PlacePhase(Phase):
    """The controls of the phase, and the target with its objects in the 3D view."""

    def __init__(self, context: PageContext, preview: PreviewPanel) -> None:
        """Build the controls."""
        self._context, self._preview, gui = context, preview, context.gui
        self._chosen, self._dragging = 0, False
        self._shown: Gizmo | None = None
        """What the fields of numbers show; as `SelectPhase._shown_box`."""
        self._note = gui.add_html("", visible=False)
        self._suggest = context.on(gui.add_button("Find a place", icon=viser.Icon.WAND), self._find_place)
        self._object_choice = context.on(gui.add_dropdown("Object", _NO_NAMES), self._choose)
        self._scale = gui.add_number("Scale", 1.0, min=1e-4, step=0.001, hint="Over its size in its own capture")
        self._size = SizeControls(context)
        self._operations = gui.add_button_group("Move", ("Drop", "Upright", "Fit size"))
        self._object_buttons = context.on(gui.add_button_group("Object ", ("Duplicate", "Delete")), self._object_button)
        with context.more_of("Place"):
            self._position = gui.add_vector3("Position", (0.0, 0.0, 0.0), step=0.001)
            self._degrees = gui.add_vector3("Rotation", (0.0, 0.0, 0.0), step=0.01, hint="Degrees about x, y, z")
            self._snap = gui.add_checkbox("Snap", False, hint=f"Turns in steps of {SNAP_DEGREES:.0f} degrees (Shift+S)")
            self._has_gizmo = context.on(
                gui.add_checkbox("Arrows and rings", False, hint="Handles for each axis, in place of dragging"),
                lambda: None,
            )
            self._size.build_more()
            self._path = gui.add_text(
                "File", "", hint="A trained scene (.ply, .spz, .sog, ...) of another object alone"
            )
            self._add = gui.add_button("Add this file", icon=viser.Icon.PLUS, color="gray")
            context.add_upload("Upload a file", SCENE_SUFFIXES, self._add_file)
            self._show_box = context.on(
                gui.add_checkbox("Box to erase in", False, hint="What is in it is taken out of the place"),
                self._toggle_box,
            )
            self._erase = gui.add_button("Erase inside the box", icon=viser.Icon.ERASER, color="gray")
            self._restore = context.on(gui.add_button("Restore all erased", color="gray"), self._restore_all)
        self._handles = BoxHandles(context.server, context.view, "/target/box", color=(240, 70, 70))
        self._gizmo = ObjectGizmo(context.server, self._dragged)
        self._hands = ObjectHands(context, on_grabbed=self._grabbed, on_dropped=self._dropped)
        preview.outlines = self._outlines
        for control in (self._position, self._degrees, self._scale):
            context.on(control, self._numbers_changed)
        context.on(self._operations, lambda: self._apply_operation(self._operations.value))
        context.on(self._add, lambda: self._add_file(parse_path(self._path.value)))
        context.on(self._erase, self._erase_box)
        self._add_key("Drop to the surface", "G", lambda: self._apply_operation("Drop"))
        self._add_key("Duplicate the object", "D", self._duplicate, modifier="cmd/ctrl")
        self._add_key("Delete the object", "delete", self._delete)
        self._add_key("Snap on or off", "S", self._toggle_snap, modifier="shift")

    def nudge(self, right: int, away: int) -> None:
        """Move the chosen object by a small step: to the right in the view, and away from the viewer."""
        session, window = self._context.require_session(), self._context.guarded.editing()
        if window is None or not session.objects():
            return
        item, placed = session.placeable_object(self._chosen), session.objects()[self._chosen].target_from_object
        dome = SkyDome.seen_along(direction_from_viser(window.camera), session.up())
        step = _NUDGE * placed.scale * max(item.base.height, item.base.radius)
        moved = placed.translation + step * (right * dome.right + away * dome.forward)
        self._set_placement(replace(placed, translation=moved))

    def leave(self) -> None:
        """Hide the handles."""
        self._handles.hide()
        self._gizmo.remove()
        self._hands.release()

    def enter(self) -> None:
        """Show the light transfer, which follows the edits."""
        self._preview.show_edits()

    def refresh(self) -> None:
        """Update the 3D view, the list of objects, the numbers and the gizmo."""
        session = self._context.session
        if session is None:
            return
        has_target = session.files.target_scene.is_file()
        objects = session.objects() if has_target else ()
        problem = None
        if not has_target:
            problem = "The place is not there yet: see Open."
        elif not objects and not session.files.object.is_file():
            problem = "There is no object yet: cut one out in Select, or add one from a file."
        self._suggest.visible = not objects and problem is None
        if not self._context.show_target() and has_target:
            problem = problem or session.scenes.reading_note(session.files.target_scene)
        self._note.visible, self._note.content = problem is not None, note(problem or "")
        is_usable = bool(objects) and session.scenes.at_hand(session.scenes.base_files(objects))
        fields = (self._position, self._degrees, self._scale)
        for control in (*fields, self._operations, self._snap, self._has_gizmo, self._object_buttons):
            control.visible = is_usable
        self._object_choice.visible = is_usable and len(objects) > 1
        self._chosen = max(0, min(self._chosen, len(objects) - 1))
        if is_usable:
            names = tuple(f"{i + 1}: {session.scenes.object_path(item).name}" for i, item in enumerate(objects))
            if tuple(self._object_choice.options) != names:
                self._object_choice.options = names
            self._object_choice.value = names[self._chosen]
            if not self._dragging:
                self._show_numbers(self._current())
                self._gizmo.snaps = self._snap.value
                if self._has_gizmo.value:
                    item = session.placeable_object(self._chosen)
                    self._gizmo.show(item, objects[self._chosen].target_from_object)
                else:
                    self._gizmo.remove()
                self._size.show(self._chosen)
        else:
            self._size.hide()
            self._gizmo.remove()
        if not self._show_box.value:
            self._handles.hide()
        self._erase.visible = self._show_box.value
        self._restore.visible = session.state.erased is not None

    def _add_key(self, label: str, key: Any, work: Callable[[], object], *, modifier: Any = None) -> None:
        command = self._context.gui.add_command(label, hotkey=key, modifier=modifier)
        self._context.on(command, lambda: work() if self._context.phase == "Place" else None)

    def _toggle_snap(self) -> None:
        self._snap.value = not self._snap.value

    # placement

    def _current(self) -> Gizmo:
        session = self._context.require_session()
        item = session.objects()[self._chosen]
        return gizmo_from_similarity(item.target_from_object, session.placeable_object(self._chosen).base.point)

    def _set_placement(self, target_from_object: Similarity) -> None:
        self._context.require_session().set_placement(self._chosen, target_from_object)

    def _show_numbers(self, gizmo: Gizmo) -> None:
        if gizmo == self._shown:
            return
        self._shown = gizmo
        self._position.value = gizmo.position
        # rounded for display, without -0; typed numbers are used exactly
        x, y, z = (round(angle, 2) + 0.0 for angle in degrees_from_quaternion(gizmo.wxyz))
        self._degrees.value = (x, y, z)
        self._scale.value = gizmo.scale

    def _numbers_changed(self) -> None:
        session = self._context.require_session()
        self._shown = None  # so that the fields go back to the state where these numbers are refused
        check_numbers((*self._position.value, *self._degrees.value, self._scale.value), "position, rotation, scale")
        gizmo = Gizmo(self._position.value, quaternion_from_degrees(self._degrees.value), float(self._scale.value))
        self._set_placement(similarity_from_gizmo(gizmo, session.placeable_object(self._chosen).base.point))
        self._shown = self._current()

    def _apply_operation(self, name: str) -> None:
        session = self._context.require_session()
        item, placed = session.placeable_object(self._chosen), session.objects()[self._chosen].target_from_object
        target, up = session.scenes.composite(session.placed_state()).target, session.up()
        if name == "Drop":
            self._set_placement(drop_to_surface(target, item, placed, up=up))
            self._context.say("dropped: it stands upright on the surface below")
        elif name == "Upright":
            self._set_placement(align_up(item, placed, up=up))
        else:
            cameras = session.scenes.cameras(session.files.target_cameras)
            self._set_placement(rescale(item, placed, plausible_scale(target, item, placed, cameras)))
            self._context.say("scaled to about a third of the views' height, which is a guess")

    def _find_place(self) -> None:
        session = self._context.require_session()
        item = session.scenes.placeable_object(ObjectPlacement(Similarity.identity()))
        cameras = session.scenes.cameras(session.files.target_cameras)
        options = session.files.place_options
        # as `compose` does
        options = replace(options, scale=session.true_scale()) if options.scale is None else options
        target = session.scenes.gaussians(session.files.target_scene)
        placed = suggest_placement(target, item, cameras, options)
        session.change(replace(session.state, objects=(ObjectPlacement(placed.target_from_object),)))
        doubts = " ".join(note.text for note in placed.warnings)
        self._context.say(
            f"placed. {doubts}" if doubts else "placed on a level, visible surface; drag it where you want it"
        )

    def _choose(self) -> None:
        self._chosen = list(self._object_choice.options).index(self._object_choice.value)
        self._gizmo.remove()

    def _object_button(self) -> None:
        if self._object_buttons.value == "Duplicate":
            self._duplicate()
        else:
            self._delete()

    def _duplicate(self) -> None:
        session = self._context.require_session()
        item = session.objects()[self._chosen]
        # objects that are placed already count as part of the scene
        scene = session.scenes.composite(session.placed_state()).merged()[0]
        object_ = session.placeable_object(self._chosen)
        placed, is_supported = place_beside(scene, object_, item.target_from_object, up=session.up())
        self._append(replace(item, target_from_object=placed))
        if not is_supported:
            self._context.say("duplicated; no surface at this height was found beside it: move it, then Drop", bad=True)

    def _delete(self) -> None:
        session = self._context.require_session()
        objects = session.objects()
        if objects:
            rest = (*objects[: self._chosen], *objects[self._chosen + 1 :])
            session.change(replace(session.state, objects=rest))
            self._gizmo.remove()

    def _add_file(self, path: Path) -> None:
        session = self._context.require_session()
        read_gaussians(path)
        item = session.scenes.placeable_object(ObjectPlacement(Similarity.identity(), path))
        # objects that are placed already count as part of the scene
        scene = session.scenes.composite(session.placed_state()).merged()[0]
        placed = suggest_placement(scene, item, session.scenes.cameras(session.files.target_cameras))
        self._append(ObjectPlacement(placed.target_from_object, path))

    def _append(self, item: ObjectPlacement) -> None:
        session = self._context.require_session()
        objects = (*session.objects(), item)
        session.change(replace(session.state, objects=objects))
        self._chosen = len(objects) - 1
        self._gizmo.remove()

    # erase

    def _toggle_box(self) -> None:
        if self._show_box.value:
            session, half = self._context.require_session(), 0.25 * self._context.scene_scale()
            target = session.scenes.gaussians(session.files.target_scene)
            is_placed = bool(session.objects())
            centre = torch.tensor(self._current().position) if is_placed else target.means.median(0).values
            self._handles.show(Box(centre - half, centre + half))

    def _erase_box(self) -> None:
        session, box = self._context.require_session(), self._handles.box
        if box is None:
            raise ValueError("box: expected one in view, found none")
        inside, before = box.contains(session.scenes.gaussians(session.files.target_scene).means), session.state.erased
        session.change(replace(session.placed_state(), erased=inside if before is None else before | inside))
        self._context.say("erased what is in the box" if bool(inside.any()) else "nothing is in the box")

    def _restore_all(self) -> None:
        session = self._context.require_session()
        session.change(replace(session.placed_state(), erased=None))

    # the pointer and the gizmo

    def _outlines(self, camera: Cameras) -> list[list[Point2]]:
        is_free = self._context.phase == "Place" and not self._has_gizmo.value
        return self._hands.outlines(camera) if is_free else []

    def _grabbed(self, index: int) -> None:
        if index != self._chosen:
            self._chosen = index
            self._context.refresh()

    def _dropped(self, index: int, placed: Similarity, mode: GrabMode) -> None:
        session = self._context.require_session()
        if mode == "move" or (mode == "lift" and self._snap.value):
            placed = self._snapped_to_surface(session, placed)
        if mode == "turn" and self._snap.value:
            gizmo = gizmo_from_similarity(placed, session.placeable_object(index).base.point)
            angles = snapped_angles(degrees_from_quaternion(gizmo.wxyz), SNAP_DEGREES)
            gizmo = replace(gizmo, wxyz=quaternion_from_degrees(angles))
            placed = similarity_from_gizmo(gizmo, session.placeable_object(index).base.point)
        session.set_placement(index, placed)

    def _dragged(self, placed: Similarity, ended: bool) -> None:
        """Show a placement during a drag, and save it at its end, as one undo step."""
        session = self._context.session
        if session is None or self._chosen >= len(session.objects()):
            return
        self._dragging = not ended
        with self._context.reported():
            if ended and self._snap.value:
                placed = self._snapped_to_surface(session, placed)
            item = replace(session.objects()[self._chosen], target_from_object=placed)
            edited = session.placed_state().with_object(self._chosen, item)
            check_state(edited)
            self._context.view.set_transform(f"/target/objects/{self._chosen}", placed)
            if not ended:
                self._preview.set_dragged_state(edited)
        if ended:
            self._context.callback(lambda _: session.set_placement(self._chosen, placed))(None)
            self._preview.set_dragged_state(None)

    def _snapped_to_surface(self, session: Session, placed: Similarity) -> Similarity:
        """The placement with its foot on the surface below or just above, where there is one near."""
        item, up = session.placeable_object(self._chosen), session.up()
        target = session.scenes.composite(session.placed_state()).target
        try:
            fallen = drop_to_surface(target, item, placed, up=up)
        except ValueError:
            return placed
        rise = float((fallen.points(item.base.point) - placed.points(item.base.point)) @ up)
        near = _SNAP_NEAR * placed.scale * item.base.height
        return replace(placed, translation=placed.translation + rise * up) if abs(rise) < near else placed


class SizeControls:
    """A height in centimetres where the target's scale is known, and under More what sets both scales."""

    def __init__(self, context: PageContext) -> None:
        """Build the controls in the current folder of the panel."""
        self._context, gui = context, context.gui
        self._index = 0
        self._shown: float | None = None
        """What the field of the height shows; as `SelectPhase._shown_box`."""
        self._height = gui.add_number("Height, cm", 0.0, min=0.0, step=0.01, hint="Of the object, in the place")
        self._true_size = gui.add_button("As tall as it truly is", color="gray", visible=False)
        self._note = gui.add_html("")
        context.on(self._height, self._typed)
        context.on(self._true_size, self._to_true_size)

    def build_more(self) -> None:
        """Build the controls that set the scales in the current folder."""
        gui = self._context.gui
        self._known = gui.add_number("True height, cm", 0.0, min=0.0, step=0.1, hint="Of the object, as measured")
        self._set = gui.add_button_group("sets scale of", _SCALES)
        self._context.on(self._set, lambda: self._set_scale(self._set.value))

    def hide(self) -> None:
        """Hide all."""
        for control in (self._height, self._true_size, self._note, self._known, self._set):
            control.visible = False

    def show(self, index: int) -> None:
        """Show the size of one placed object."""
        self._index = index
        self._note.visible = self._known.visible = self._set.visible = True
        try:
            session = self._context.require_session()
            size = session.size(index)
        except ValueError as error:
            self._height.visible = self._true_size.visible = False
            self._note.content = note(html.escape(str(error)), kind="size", faint=True)
            return
        here, true = size.here_cm, size.true_cm
        self._height.visible = here is not None
        self._true_size.visible = here is not None and true is not None and abs(here / true - 1) > _SAME
        if here is not None and here != self._shown:
            self._shown = here
            self._height.value = round(here, 2)
        given = session.files.place_options.scale
        is_given = given is not None and abs(size.scale / given - 1) < _SAME
        self._note.content = note(html.escape(_about(size, is_given=is_given)), kind="size", faint=True)

    def _typed(self) -> None:
        self._shown = None  # so that the field goes back where this number is refused
        self._resize(float(self._height.value))

    def _to_true_size(self) -> None:
        true = self._context.require_session().size(self._index).true_cm
        if true is not None:
            self._resize(true)

    def _resize(self, here_cm: float) -> None:
        session = self._context.require_session()
        scale, placed = session.size(self._index).scale_at(here_cm), session.objects()[self._index].target_from_object
        session.set_placement(self._index, rescale(session.placeable_object(self._index), placed, scale))

    def _set_scale(self, of: str) -> None:
        session, cm = self._context.require_session(), float(self._known.value)
        if of == _SCALES[0]:
            path = session.set_own_scale(self._index, cm)
            if session.size(self._index).place is not None:
                self._resize(cm)
        else:
            path = session.set_place_scale(self._index, cm)
        self._context.say(f"stored in {path}, as `splatgraft scale` does; Undo leaves it")


def _about(size: ObjectSize, *, is_given: bool) -> str:
    """What is known of an object's size, and how to tell the rest; `is_given`: project.toml says the scale."""
    if size.place is None and is_given:
        return f"Its size is what the project says: {size.scale:.4g} times that in its own photos."
    if size.place is None:
        return "Its size here is a guess, as nobody has measured the place: under More, type the object's true height."
    if size.own is None:
        return "How tall it truly is, is not known: type it under More."
    return f"In its own photos it is {size.true_cm:.4g} cm tall."
