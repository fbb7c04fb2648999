"""The step `Place`: place objects by the pointer, numbers and operations; erase parts of the target."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.places import scale_in_view
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity
from splatgraft.editor.drag import Drag, DragMode, outline
from splatgraft.editor.form import Form
from splatgraft.editor.open_panel import parse_path
from splatgraft.editor.panel import CORNERS, Panel, Pointer, box_over
from splatgraft.editor.pictures import same_places
from splatgraft.editor.placement import (
    ObjectSize,
    PlaceableObject,
    degrees_of,
    drop_to_surface,
    place_beside,
    rescale,
    rotation_of,
    suggest_placement,
    with_base,
)
from splatgraft.editor.state import check_height_cm
from splatgraft.editor.stream import View
from splatgraft.formats import SCENE_SUFFIXES, read_gaussians
from splatgraft.project.layout import SIDES, Side
from splatgraft.project.metric_scale import read_scale, true_scale
from splatgraft.project.placement import ObjectPlacement
from splatgraft.segmentation import Box

_NUDGE = 0.05  # step of an arrow key over the object's height
_SNAP_DEGREES = 15.0
_SAME = 0.002  # relative difference below which two sizes count as equal
_MIN_OPACITY = 0.3  # lowest opacity of Gaussians that count for the outline of their object
_MODES = {"move": "W", "turn": "R", "size": "S", "lift": "E"}
_RED = "#f04646"


class PlacePanel(Panel):
    """Controls of the objects, and the target with its objects in the view."""

    _chosen, _snaps, _known_cm = 0, False, 0.0
    _drag: tuple[int, DragMode, tuple[float, float], Drag] | None = None
    _box: Box | None = None

    def leave(self) -> None:
        """End drags and remove the box."""
        super().leave()
        self._drag = self._box = None

    def tools(self) -> dict[str, Any]:
        """Return the drag modes of an object."""
        session = self.editor.session
        if session is None or not session.objects():
            return {}
        return {"tools": [[mode, mode.capitalize(), key] for mode, key in _MODES.items()]}

    def build(self, form: Form) -> None:
        """Add the controls."""
        session = self.session
        if not session.files.scenes["target"].is_file():
            form.note("The place is not there yet: see Open.")
            return
        objects = session.objects()
        self._chosen = max(0, min(self._chosen, len(objects) - 1))
        if objects:
            self._build_object(form, objects)
        elif session.files.object.is_file():
            form.button("find", "Find a place", self._find_place, main=True)
        else:
            form.note("There is no object yet: cut one out in Select, or add one from a file.")
        form.more()
        if objects:
            self._build_numbers(form)
        hint = "A trained scene (.ply, .spz, .sog, ...)"
        form.text("file", "File of another object", "", self._add_file, hint=hint)
        form.upload("upload_object", "Upload a file", SCENE_SUFFIXES)
        is_boxed = self._box is not None
        form.check("erase_box", "Box to erase in", is_boxed, self._toggle_box, hint="What is in it is taken out")
        if is_boxed:
            form.button("erase", "Erase inside the box", self._erase)
        if session.state.erased is not None:
            form.button("restore", "Restore all erased", lambda: self._change(erased=None))

    def _build_object(self, form: Form, objects: tuple[ObjectPlacement, ...]) -> None:
        if len(objects) > 1:
            paths = [self.session.scenes.object_path(item) for item in objects]
            numbers = {f"{i + 1}: {path.name}": i for i, path in enumerate(paths)}
            form.choice("object", "Object", self._chosen, numbers, self._sets("_chosen"))
        scale, hint = objects[self._chosen].target_from_object.scale, "Over its size in its own photos"
        form.number("scale", "Scale", scale, lambda value: self._typed(scale=value), hint=hint)
        self._build_size(form)
        form.buttons("move", {"Drop": self._drop, "Fit size": self._fit_size})
        form.buttons("count", {"Duplicate": self._duplicate, "Delete": self._delete})
        form.note("Drag it along its support; with Alt onto another one.", name="hint", faint=True)

    def _build_numbers(self, form: Form) -> None:
        form.numbers("position", "Position", self._base().tolist(), lambda v: self._typed(position=v))
        # rounded for display, without -0; typed numbers are used exactly
        angles = [round(angle, 2) + 0.0 for angle in degrees_of(self._one()[1].rotation)]
        hint = "Degrees about x, y, z"
        form.numbers("rotation", "Rotation", angles, lambda v: self._typed(degrees=v), step=0.01, hint=hint)
        form.check("snap", "Snap", self._snaps, self._sets("_snaps"), hint="Turns by 15 degrees (Shift+S)")
        form.number("known", "True height, cm", self._known_cm, self._sets("_known_cm"), hint="As measured")
        sets: dict[str, Side] = {"Scale of its photos": "source", "Scale of the place": "target"}
        form.buttons("sets", {label: partial(self._set_scale, side) for label, side in sets.items()})

    def _build_size(self, form: Form) -> None:
        try:
            size = self.session.size(self._chosen)
        except ValueError as error:
            form.note(str(error), name="size", faint=True)
            return
        if size.cm_per_scale is not None:
            here = round(size.scale * size.cm_per_scale, 2)
            form.number("height", "Height, cm", here, self._resize, step=0.01, hint="In the place")
        given = self.session.files.compose.options.scale
        is_given = given is not None and abs(size.scale / given - 1) < _SAME
        form.note(_about(size, is_given=is_given), name="size", faint=True)

    # placement by numbers and operations

    def _one(self) -> tuple[PlaceableObject, Similarity]:
        """Return the chosen object and its placement."""
        return self.session.placeable_object(self._chosen), self.session.objects()[self._chosen].target_from_object

    def _base(self) -> Float[Tensor, "3"]:
        """Return the chosen object's base point in the target."""
        item, placed = self._one()
        return placed.points(item.base.point)

    def _typed(self, *, position: Any = None, degrees: Any = None, scale: float | None = None) -> None:
        item, placed = self._one()
        at = self._base() if position is None else torch.tensor(position)
        rotation = placed.rotation if degrees is None else rotation_of(degrees)
        size = placed.scale if scale is None else scale
        self._place(with_base(item, Similarity(size, rotation, placed.translation), at=at))

    def _place(self, target_from_object: Similarity) -> None:
        self.session.set_placement(self._chosen, target_from_object)

    def _change(self, **fields: Any) -> None:
        """Change fields of the state with the objects of `compose` filled in."""
        self.session.change(replace(self.session.placed_state(), **fields))

    def _drop(self) -> None:
        (item, placed), scenes = self._one(), self.session.scenes
        target = scenes.composite(self.session.placed_state()).target
        self._place(drop_to_surface(target, item, placed, up=self.session.up()))
        self.editor.say("dropped: it stands upright on the surface below")

    def _fit_size(self) -> None:
        (item, placed), session = self._one(), self.session
        cameras = session.scenes.cameras("target")
        self._place(rescale(item, placed, scale_in_view(item.base, self._base(), cameras=cameras)))
        self.editor.say("scaled to about a third of the views' height, which is a guess")

    def _find_place(self) -> None:
        session = self.session
        item = session.scenes.placeable_object(ObjectPlacement(Similarity.identity()))
        cameras = session.scenes.cameras("target")
        options = session.files.compose.options
        if options.scale is None:  # as in `compose`
            options = replace(options, scale=true_scale(*(read_scale(session.files.cameras[side]) for side in SIDES)))
        placed = suggest_placement(session.scenes.scene("target"), item, cameras, options)
        self._change(objects=(ObjectPlacement(placed.target_from_object),))
        doubts = " ".join(note.text for note in placed.warnings)
        self.editor.say(
            f"placed. {doubts}" if doubts else "placed on a level, visible surface; drag it where you want it"
        )

    def _duplicate(self) -> None:
        session, (item, placed) = self.session, self._one()
        beside, is_supported = place_beside(self._merged(), item, placed, up=session.up())
        self._append(replace(session.objects()[self._chosen], target_from_object=beside))
        if not is_supported:
            self.editor.say("duplicated; no surface at this height was found beside it: move it, then Drop", bad=True)

    def _delete(self) -> None:
        objects = self.session.objects()
        self._change(objects=(*objects[: self._chosen], *objects[self._chosen + 1 :]))

    def uploaded(self, path: Path, use: str) -> None:
        """Add an uploaded object."""
        if use == "upload_object":
            self._add_file(str(path))

    def _add_file(self, given: str) -> None:
        path, session = parse_path(given), self.session
        read_gaussians(path)
        item = session.scenes.placeable_object(ObjectPlacement(Similarity.identity(), path))
        placed = suggest_placement(self._merged(), item, session.scenes.cameras("target"))
        self._append(ObjectPlacement(placed.target_from_object, path))

    def _merged(self) -> Gaussians:
        """Return the target with its objects, which a further object is placed among."""
        return self.session.scenes.composite(self.session.placed_state()).merged()[0]

    def _append(self, item: ObjectPlacement) -> None:
        objects = (*self.session.objects(), item)
        self._change(objects=objects)
        self._chosen = len(objects) - 1

    def _resize(self, here_cm: float) -> None:
        check_height_cm(here_cm)
        cm_per_scale = self.session.size(self._chosen).cm_per_scale
        assert cm_per_scale is not None
        self._place(rescale(*self._one(), here_cm / cm_per_scale))

    def _set_scale(self, side: Side) -> None:
        session, cm = self.session, self._known_cm
        path = session.set_scale(self._chosen, cm, side)
        if side == "source" and session.size(self._chosen).cm_per_scale is not None:
            self._resize(cm)
        self.editor.say(f"stored in {path}, as `splatgraft scale` does; Undo leaves it")

    # keys

    def key(self, view: View, key: str) -> bool:
        """Handle the keys of this step."""
        if not self.session.objects():
            return False
        arrows = {"arrowleft": (-1, 0), "arrowright": (1, 0), "arrowup": (0, 1), "arrowdown": (0, -1)}
        work: dict[str, Callable[[], object]] = {
            "g": self._drop,
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
        item, placed = self._one()
        up, across = self.session.up(), self.camera(view).world_from_camera[0, :3, 0]
        across = torch.nn.functional.normalize(across - (across @ up) * up, dim=0)
        step = _NUDGE * placed.scale * max(item.base.height, item.base.radius)
        shift = step * (right * across + away * torch.linalg.cross(up, across))
        self._place(replace(placed, translation=placed.translation + shift))

    # the pointer

    def overlay(self, view: View, camera: Cameras) -> dict[str, Any]:
        """Describe the outlines by which objects are dragged, and the box to erase in."""
        items, scenes, hulls = self.editor.shown_state().objects or (), self.session.scenes, []
        for item in items:
            path = scenes.object_path(item)
            one = scenes.gaussians(path)
            solid = scenes.derive(f"solid {path}", (one,), lambda one=one: one.means[one.opacities > _MIN_OPACITY])
            hulls.append(outline(item.target_from_object.points(solid), camera))
        over: dict[str, Any] = {"hulls": hulls, "chosen": self._chosen if len(items) > 1 else -1}
        if self._box is not None:
            over |= box_over(self._box, camera, _RED)
        return over

    def pointer(self, view: View, pointer: Pointer) -> None:
        """Drag an object, or a corner of the box."""
        if pointer.on in CORNERS:
            self._box = self.dragged_box(view, pointer, self._box) or self._box
            self.editor.stream.touch(moving=True)
        elif pointer.what == "down" and pointer.on.startswith("object:"):
            self._grab(view, pointer)
        elif self._drag is not None:
            self._move(pointer)

    def _grab(self, view: View, pointer: Pointer) -> None:
        index, objects = int(pointer.on.removeprefix("object:")), self.session.objects()
        if not 0 <= index < len(objects) or pointer.mode not in get_args(DragMode):
            raise ValueError("There is no object under the pointer.")
        mode: Any = "lift" if pointer.shift else pointer.mode
        self._chosen = index
        rest = replace(self.session.placed_state(), objects=(*objects[:index], *objects[index + 1 :]))
        place = self.session.pictures.lit.pasted(rest) if rest.objects else self.session.pictures.lit.place(rest)
        held = Drag(*self._one(), self.camera(view), place, up=self.session.up())
        self._drag = (index, mode, pointer.place, held)

    def _move(self, pointer: Pointer) -> None:
        assert self._drag is not None
        session, (index, mode, start, held) = self.session, self._drag
        if pointer.what == "cancel" or index >= len(session.objects()):
            self._drag = None
            self.editor.show_live(None)
            return
        placed = held.at(mode, start, pointer.place, anywhere=pointer.alt)
        if mode == "turn" and self._snaps:
            x, y, z = (_SNAP_DEGREES * round(angle / _SNAP_DEGREES) for angle in degrees_of(placed.rotation))
            foot = placed.points(held.item.base.point)
            placed = with_base(held.item, replace(placed, rotation=rotation_of((x, y, z))), at=foot)
        item = replace(session.objects()[index], target_from_object=placed)
        edited = session.placed_state().with_object(index, item)
        if pointer.what == "up":
            self._drag = None
            # the shown state itself, so that its light stays valid
            shown = self.editor.live
            session.change(shown if shown is not None and same_places(shown.objects, edited.objects) else edited)
            self.editor.show_live(None)
        else:
            self.editor.show_live(edited)

    # erasing

    def _toggle_box(self, value: bool) -> None:
        session, half = self.session, 0.25 * self.editor.scene_scale()
        target = session.scenes.scene("target")
        centre = self._base() if session.objects() else target.means.median(0).values
        self._box = Box(centre - half, centre + half) if value else None

    def _erase(self) -> None:
        assert self._box is not None
        inside, before = self._box.contains(self.session.scenes.scene("target").means), self.session.state.erased
        self._change(erased=inside if before is None else before | inside)
        self.editor.say("erased what is in the box" if bool(inside.any()) else "nothing is in the box")


def _about(size: ObjectSize, *, is_given: bool) -> str:
    """Describe an object's known size and how to enter the rest; `is_given`: project.toml sets the scale."""
    if size.cm_per_scale is None and is_given:
        return f"{size.scale:.4g} times its size in its photos, as the project says."
    if size.cm_per_scale is None:
        return "Its size here is a guess, as nobody has measured the place: under More, type the object's true height."
    if size.true_cm is None:
        return "How tall it truly is, is not known: type it under More."
    return f"In its own photos it is {size.true_cm:.4g} cm tall."
