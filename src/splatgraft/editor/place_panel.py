"""The step `Place`: place objects by the pointer, numbers and operations; erase parts of the target."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.similarity import Similarity
from splatgraft.editor.drag import Drag, DragMode, outline
from splatgraft.editor.form import Form
from splatgraft.editor.panel import CORNERS, BoxDrag, Panel, Pointer, box_over, view_camera
from splatgraft.editor.pictures import same_places
from splatgraft.editor.placement import (
    ObjectSize,
    align_up,
    degrees_of,
    drop_to_surface,
    place_beside,
    plausible_scale,
    rescale,
    rotation_of,
    snapped_angles,
    suggest_placement,
    with_base,
)
from splatgraft.editor.session import Session
from splatgraft.editor.sky_dome import SkyDome
from splatgraft.editor.state import check_numbers, check_state
from splatgraft.editor.stream import View
from splatgraft.formats import SCENE_SUFFIXES, read_gaussians
from splatgraft.project.placement import ObjectPlacement
from splatgraft.runtime.memo import Memo
from splatgraft.segmentation import Box

if TYPE_CHECKING:
    from splatgraft.editor.editor import Editor

_NUDGE = 0.05  # step of an arrow key over the object's height
_SNAP_DEGREES = 15.0
_SAME = 0.002  # relative difference below which two sizes count as equal
_MIN_OPACITY = 0.3  # lowest opacity of Gaussians that count for the outline of their object
_MODES = {"move": "W", "turn": "R", "size": "S", "lift": "E"}
_RED = "#f04646"


class PlacePanel(Panel):
    """Controls of the objects, and the target with its objects in the view."""

    def __init__(self, editor: "Editor") -> None:
        """Start without a drag or box."""
        super().__init__(editor)
        self._chosen, self._snaps, self._path, self._known_cm = 0, False, "", 0.0
        self._drag: tuple[int, DragMode, tuple[float, float], Drag] | None = None
        self._box: Box | None = None
        self._held_box: BoxDrag | None = None
        self._solid = Memo()

    def leave(self) -> None:
        """End drags and remove the box."""
        self._drag = self._box = self._held_box = None

    def tools(self) -> dict[str, Any]:
        """Return the drag modes of an object."""
        session = self.editor.session
        is_any = session is not None and bool(session.objects())
        return {"tools": [[mode, mode.capitalize(), key] for mode, key in _MODES.items()]} if is_any else {}

    def build(self, form: Form) -> None:
        """Add the controls."""
        session = self.editor.require_session()
        if not session.files.target_scene.is_file():
            form.note("The place is not there yet: see Open.")
            return
        objects = session.objects()
        self._chosen = max(0, min(self._chosen, len(objects) - 1))
        if not objects and not session.files.object.is_file():
            form.note("There is no object yet: cut one out in Select, or add one from a file.")
        elif not objects:
            form.button("find", "Find a place", self._find_place, main=True)
        else:
            self._build_object(form, session, objects)
        form.more()
        if objects:
            self._build_numbers(form, session)
        form.text(
            "file", "File of another object", self._path, self._set_path, hint="A trained scene (.ply, .spz, .sog, ...)"
        )
        form.button("add", "Add this file", lambda: self._add_file(self._path), disabled=not self._path)
        form.upload("upload_object", "Upload a file", SCENE_SUFFIXES)
        form.check(
            "erase_box", "Box to erase in", self._box is not None, self._toggle_box, hint="What is in it is taken out"
        )
        if self._box is not None:
            form.button("erase", "Erase inside the box", self._erase)
        if session.state.erased is not None:
            form.button(
                "restore", "Restore all erased", lambda: session.change(replace(session.placed_state(), erased=None))
            )

    def _build_object(self, form: Form, session: Session, objects: tuple[ObjectPlacement, ...]) -> None:
        if len(objects) > 1:
            names = [f"{i + 1}: {session.scenes.object_path(item).name}" for i, item in enumerate(objects)]
            form.choice(
                "object", "Object", names[self._chosen], names, lambda v: setattr(self, "_chosen", names.index(v))
            )
        scale = objects[self._chosen].target_from_object.scale
        form.numbers(
            "scale", "Scale", [scale], lambda v: self._typed(scale=v[0]), hint="Over its size in its own photos"
        )
        self._build_size(form, session)
        form.buttons("move", {name: partial(self._operate, name) for name in ("Drop", "Upright", "Fit size")})
        form.buttons("count", {"Duplicate": self._duplicate, "Delete": self._delete})
        form.note("Drag it along its support; with Alt onto another one.", name="hint", faint=True)

    def _build_numbers(self, form: Form, session: Session) -> None:
        placed = session.objects()[self._chosen].target_from_object
        form.numbers("position", "Position", self._base(session).tolist(), lambda v: self._typed(position=v))
        # rounded for display, without -0; typed numbers are used exactly
        angles = [round(angle, 2) + 0.0 for angle in degrees_of(placed.rotation)]
        form.numbers(
            "rotation", "Rotation", angles, lambda v: self._typed(degrees=v), step=0.01, hint="Degrees about x, y, z"
        )
        form.check(
            "snap", "Snap", self._snaps, lambda v: setattr(self, "_snaps", v), hint="Turns by 15 degrees (Shift+S)"
        )
        form.numbers(
            "known", "True height, cm", [self._known_cm], lambda v: setattr(self, "_known_cm", v[0]), hint="As measured"
        )
        form.buttons(
            "sets",
            {
                "Scale of its photos": lambda: self._set_scale(own=True),
                "Scale of the place": lambda: self._set_scale(own=False),
            },
        )

    def _build_size(self, form: Form, session: Session) -> None:
        try:
            size = session.size(self._chosen)
        except ValueError as error:
            form.note(str(error), name="size", faint=True)
            return
        here, true = size.here_cm, size.true_cm
        if here is not None:
            form.numbers(
                "height", "Height, cm", [round(here, 2)], lambda v: self._resize(v[0]), step=0.01, hint="In the place"
            )
            if true is not None and abs(here / true - 1) > _SAME:
                form.button("true_size", "As tall as it truly is", lambda: self._resize(true))
        given = session.files.place_options.scale
        form.note(
            _about(size, is_given=given is not None and abs(size.scale / given - 1) < _SAME), name="size", faint=True
        )

    # placement by numbers and operations

    def _base(self, session: Session) -> Float[Tensor, "3"]:
        """Return the chosen object's base point in the target."""
        placed = session.objects()[self._chosen].target_from_object
        return placed.points(session.placeable_object(self._chosen).base.point)

    def _typed(self, *, position: Any = None, degrees: Any = None, scale: float | None = None) -> None:
        session = self.editor.require_session()
        item, placed = session.placeable_object(self._chosen), session.objects()[self._chosen].target_from_object
        check_numbers(degrees or (), "rotation")
        check_numbers((*(position or ()), placed.scale if scale is None else scale), "position, scale")
        if scale is not None and scale <= 0:
            raise ValueError(f"scale: expected a number above 0, found {scale:g}")
        at = self._base(session) if position is None else torch.tensor(position)
        rotation = placed.rotation if degrees is None else rotation_of(degrees)
        self._place(with_base(item, Similarity(scale or placed.scale, rotation, placed.translation), at=at))

    def _place(self, target_from_object: Similarity) -> None:
        self.editor.require_session().set_placement(self._chosen, target_from_object)

    def _operate(self, name: str) -> None:
        session = self.editor.require_session()
        if not session.objects():
            return
        item, placed = session.placeable_object(self._chosen), session.objects()[self._chosen].target_from_object
        target, up = session.scenes.composite(session.placed_state()).target, session.up()
        if name == "Drop":
            self._place(drop_to_surface(target, item, placed, up=up))
            self.editor.say("dropped: it stands upright on the surface below")
        elif name == "Upright":
            self._place(align_up(item, placed, up=up))
        else:
            cameras = session.scenes.cameras(session.files.target_cameras)
            self._place(rescale(item, placed, plausible_scale(target, item, placed, cameras)))
            self.editor.say("scaled to about a third of the views' height, which is a guess")

    def _find_place(self) -> None:
        session = self.editor.require_session()
        item = session.scenes.placeable_object(ObjectPlacement(Similarity.identity()))
        cameras = session.scenes.cameras(session.files.target_cameras)
        options = session.files.place_options
        # as `compose` does
        options = replace(options, scale=session.true_scale()) if options.scale is None else options
        placed = suggest_placement(session.scenes.gaussians(session.files.target_scene), item, cameras, options)
        session.change(replace(session.state, objects=(ObjectPlacement(placed.target_from_object),)))
        doubts = " ".join(note.text for note in placed.warnings)
        self.editor.say(
            f"placed. {doubts}" if doubts else "placed on a level, visible surface; drag it where you want it"
        )

    def _duplicate(self) -> None:
        session = self.editor.require_session()
        if not session.objects():
            return
        item, object_ = session.objects()[self._chosen], session.placeable_object(self._chosen)
        # objects that are placed already count as part of the scene
        scene = session.scenes.composite(session.placed_state()).merged()[0]
        placed, is_supported = place_beside(scene, object_, item.target_from_object, up=session.up())
        self._append(replace(item, target_from_object=placed))
        if not is_supported:
            self.editor.say("duplicated; no surface at this height was found beside it: move it, then Drop", bad=True)

    def _delete(self) -> None:
        session = self.editor.require_session()
        objects = session.objects()
        if objects:
            rest = (*objects[: self._chosen], *objects[self._chosen + 1 :])
            session.change(replace(session.state, objects=rest))

    def _set_path(self, value: str) -> None:
        self._path = value.strip()

    def uploaded(self, path: Path, use: str) -> None:
        """Add an uploaded object."""
        if use == "upload_object":
            self._add_file(str(path))

    def _add_file(self, given: str) -> None:
        path, session = Path.cwd() / Path(given).expanduser(), self.editor.require_session()
        read_gaussians(path)
        item = session.scenes.placeable_object(ObjectPlacement(Similarity.identity(), path))
        scene = session.scenes.composite(session.placed_state()).merged()[0]
        placed = suggest_placement(scene, item, session.scenes.cameras(session.files.target_cameras))
        self._append(ObjectPlacement(placed.target_from_object, path))

    def _append(self, item: ObjectPlacement) -> None:
        session = self.editor.require_session()
        objects = (*session.objects(), item)
        session.change(replace(session.state, objects=objects))
        self._chosen = len(objects) - 1

    def _resize(self, here_cm: float) -> None:
        session = self.editor.require_session()
        scale, placed = session.size(self._chosen).scale_at(here_cm), session.objects()[self._chosen].target_from_object
        self._place(rescale(session.placeable_object(self._chosen), placed, scale))

    def _set_scale(self, *, own: bool) -> None:
        session, cm = self.editor.require_session(), self._known_cm
        if own:
            path = session.set_own_scale(self._chosen, cm)
            if session.size(self._chosen).place is not None:
                self._resize(cm)
        else:
            path = session.set_place_scale(self._chosen, cm)
        self.editor.say(f"stored in {path}, as `splatgraft scale` does; Undo leaves it")

    # keys

    def key(self, view: View, key: str) -> bool:
        """Handle the keys of this step."""
        arrows = {"arrowleft": (-1, 0), "arrowright": (1, 0), "arrowup": (0, 1), "arrowdown": (0, -1)}
        work: dict[str, Callable[[], object]] = {
            "g": lambda: self._operate("Drop"),
            "ctrl+d": self._duplicate,
            "delete": self._delete,
            "backspace": self._delete,
            "shift+s": lambda: setattr(self, "_snaps", not self._snaps),
        }
        if key in arrows:
            self._nudge(view, *arrows[key])
        elif key in work:
            work[key]()
        return key in arrows or key in work

    def _nudge(self, view: View, right: int, away: int) -> None:
        """Move the chosen object by small steps to the right in the view and away from the viewer."""
        session, orbit = self.editor.require_session(), self.editor.orbit(view)
        if orbit is None or not session.objects():
            return
        item, placed = session.placeable_object(self._chosen), session.objects()[self._chosen].target_from_object
        dome = SkyDome.seen_along(torch.tensor(orbit.forward).float(), session.up())
        step = _NUDGE * placed.scale * max(item.base.height, item.base.radius)
        self._place(replace(placed, translation=placed.translation + step * (right * dome.right + away * dome.forward)))

    # the pointer

    def overlay(self, view: View, camera: Cameras) -> dict[str, Any]:
        """Describe the outlines by which objects are dragged, and the box to erase in."""
        session = self.editor.require_session()
        items = self.editor.shown_state().objects or ()
        hulls = []
        for item in items:
            # without the object's base and the scenes' memo, for which the first picture would wait
            path = session.scenes.object_path(item)
            one = session.scenes.gaussians(path)
            solid = self._solid.get(str(path), (one,), lambda one=one: one.means[one.opacities > _MIN_OPACITY])
            hulls.append(outline(item.target_from_object.points(solid), camera))
        over: dict[str, Any] = {"hulls": hulls, "chosen": self._chosen if len(items) > 1 else -1}
        if self._box is not None:
            over |= box_over(self._box, camera, _RED)
        return over

    def pointer(self, view: View, pointer: Pointer) -> None:
        """Drag an object, or a corner of the box."""
        if pointer.on in CORNERS:
            self._drag_box(view, pointer)
        elif pointer.what == "down" and pointer.on.startswith("object:"):
            self._grab(view, pointer)
        elif self._drag is not None:
            self._move(pointer)

    def _grab(self, view: View, pointer: Pointer) -> None:
        session, index = self.editor.require_session(), int(pointer.on.removeprefix("object:"))
        modes: tuple[DragMode, ...] = get_args(DragMode)
        if not 0 <= index < len(session.objects()) or pointer.mode not in modes or self.editor.pictures is None:
            raise ValueError("There is no object under the pointer.")
        mode: DragMode = "lift" if pointer.shift else modes[modes.index(pointer.mode)]  # pyright: ignore[reportArgumentType]
        self._chosen = index
        objects = session.objects()
        rest = replace(session.placed_state(), objects=(*objects[:index], *objects[index + 1 :]))
        place = self.editor.pictures.lit.pasted(rest) if rest.objects else self.editor.pictures.lit.place(rest)
        held = Drag(
            session.placeable_object(index),
            objects[index].target_from_object,
            view_camera(self.editor, view),
            place,
            up=session.up(),
        )
        self._drag = (index, mode, pointer.place, held)

    def _move(self, pointer: Pointer) -> None:
        assert self._drag is not None
        session, (index, mode, start, held) = self.editor.require_session(), self._drag
        if pointer.what == "cancel" or index >= len(session.objects()):
            self._drag = None
            self.editor.show_live(None)
            return
        placed = held.at(mode, start, pointer.place, anywhere=pointer.alt)
        if mode == "turn" and self._snaps:
            turned = rotation_of(snapped_angles(degrees_of(placed.rotation), _SNAP_DEGREES))
            foot = placed.points(held.item.base.point)
            placed = with_base(held.item, replace(placed, rotation=turned), at=foot)
        item = replace(session.objects()[index], target_from_object=placed)
        edited = session.placed_state().with_object(index, item)
        check_state(edited)
        if pointer.what == "up":
            self._drag = None
            # the shown state itself, so that its light stays valid
            shown = self.editor.live
            session.change(shown if shown is not None and same_places(shown.objects, edited.objects) else edited)
            self.editor.show_live(None)
        else:
            self.editor.show_live(edited)

    def _drag_box(self, view: View, pointer: Pointer) -> None:
        if pointer.what == "down" and self._box is not None:
            self._held_box = BoxDrag(self._box, pointer.on, view_camera(self.editor, view))
        elif self._held_box is not None:
            if pointer.what != "cancel":
                self._box = self._held_box.at(pointer.place)
            if pointer.what != "move":
                self._held_box = None
            self.editor.stream.touch(moving=True)

    # erasing

    def _toggle_box(self, value: bool) -> None:
        session, half = self.editor.require_session(), 0.25 * self.editor.scene_scale()
        target = session.scenes.gaussians(session.files.target_scene)
        centre = self._base(session) if session.objects() else target.means.median(0).values
        self._box = Box(centre - half, centre + half) if value else None

    def _erase(self) -> None:
        session, box = self.editor.require_session(), self._box
        assert box is not None
        inside, before = box.contains(session.scenes.gaussians(session.files.target_scene).means), session.state.erased
        session.change(replace(session.placed_state(), erased=inside if before is None else before | inside))
        self.editor.say("erased what is in the box" if bool(inside.any()) else "nothing is in the box")


def _about(size: ObjectSize, *, is_given: bool) -> str:
    """Describe an object's known size and how to enter the rest; `is_given`: project.toml sets the scale."""
    if size.place is None and is_given:
        return (
            "Same size as in its photos."
            if math.isclose(size.scale, 1.0)
            else f"{size.scale:.4g} times its size in its photos, as the project says."
        )
    if size.place is None:
        return "Its size here is a guess, as nobody has measured the place: under More, type the object's true height."
    if size.own is None:
        return "How tall it truly is, is not known: type it under More."
    return f"In its own photos it is {size.true_cm:.4g} cm tall."
