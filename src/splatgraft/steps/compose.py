"""The command `compose`: place an object in a target scene, by a given placement or on a surface with room for it."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

from splatgraft.composition import NoFreePlaceError, Placed, PlaceOptions, place_object
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import write_image
from splatgraft.folders.capture_files import camera_files
from splatgraft.folders.composite_folder import composite_of, placement_files, write_composite
from splatgraft.folders.picture_points import point_in_world
from splatgraft.formats import read_cameras, read_gaussians, read_images
from splatgraft.project.layout import COVERAGE_FILE
from splatgraft.project.metric_scale import MetricScale, find_scale, read_scale, true_scale
from splatgraft.project.placement import ObjectPlacement, Placement, read_placement
from splatgraft.project.step import Context, Inputs
from splatgraft.runtime.note import Note

_MUCH_UNSEEN = 0.2  # share of the target's images; warn if more of them show an unphotographed side


@dataclass(frozen=True)
class Compose:
    """Place the object in the target: by placement.json, or upright on a surface with room for it."""

    remedy: ClassVar[str] = (
        "drag the object to where it should stand and press Drop: splatgraft edit PROJECT, step Place"
    )

    target: Path
    """The scene that receives the object, a .ply."""
    object: Path
    """The object's Gaussians, a .ply; a placement may name others beside it."""
    out: Path = Path("composite")
    """Folder for placement.json, which `relight` reads, and the composite as scene.ply and is_object.npy."""
    placement: Path | None = None
    """placement.json; if not given, the object is rested on a surface, which needs both captures' cameras."""
    cameras: Path | None = None
    """The target's cameras, a capture folder or its transforms.json; they give the up direction and the visible
    region."""
    object_cameras: Path | None = None
    """The source's cameras, likewise."""
    surroundings: Path | None = None
    """The source without the object, a .ply; the surface that the object stood on gives the object's base."""
    on: str | None = None
    """Rest the object on the surface that an image of the target shows at a pixel, "IMAGE:X,Y"; replaces --point."""
    options: PlaceOptions = field(default_factory=PlaceOptions)

    def inputs(self) -> Inputs:
        """Return the scenes, and the placement with its files or the cameras."""
        scenes = {"target": (self.target,), "object": (self.object,)}
        if self.placement is not None:
            return scenes | {"placement": placement_files(self.placement)}
        captures = [path for path in (self.cameras, self.object_cameras) if path is not None]
        cameras = [file for path in captures for file in camera_files(path)]
        scales = [path for path in map(find_scale, captures) if path is not None]
        surroundings = [] if self.surroundings is None else [self.surroundings]
        return scenes | {"cameras": (*cameras, *surroundings, *scales)}

    def write(self, folder: Path, context: Context) -> None:
        """Write the composite; if there is no room, write a picture of the free places beside the folder instead."""
        self._free_places.unlink(missing_ok=True)
        target, object_ = read_gaussians(self.target), read_gaussians(self.object)
        placement = (
            self._found(target, object_, folder, context) if self.placement is None else read_placement(self.placement)
        )
        named = tuple(replace(item, object_path=item.object_path or self.object) for item in placement.objects)
        placement = replace(placement, objects=named)
        write_composite(folder, composite_of(target, placement, known={self.object: object_}), placement)

    @property
    def _free_places(self) -> Path:
        """Picture beside the result's folder, because a failed step leaves that folder unchanged."""
        return self.out.with_name(f"{self.out.name}_free_places.png")

    def _found(self, target: Gaussians, object_: Gaussians, folder: Path, context: Context) -> Placement:
        """Place the object on a level surface of the target."""
        if self.cameras is None or self.object_cameras is None:
            raise ValueError(
                "compose: expected --placement, or --cameras and --object-cameras to find a place, found neither"
            )
        if self.on is not None and self.options.point is not None:
            raise ValueError("compose: expected --point or --on, found both")
        cameras = (read_cameras(self.cameras), read_cameras(self.object_cameras))
        surroundings = None if self.surroundings is None else read_gaussians(self.surroundings)
        options = self.options
        if self.on is not None:
            x, y, z = point_in_world(self.on, read_images(self.cameras), target, option="--on").tolist()
            options = replace(options, point=(x, y, z))
        in_metres = [read_scale(path) for path in (self.object_cameras, self.cameras)]
        if options.scale is None:
            options = replace(options, scale=true_scale(*in_metres))
        try:
            placed = place_object(target, object_, cameras=cameras, surroundings=surroundings, options=options)
        except NoFreePlaceError as error:
            write_image(self._free_places, error.picture)
            shown = f"{self._free_places} shows free places green and what stands there red"
            raise ValueError(f"{error}; {shown}") from error
        where = ", ".join(f"{x:.3f}" for x in placed.support.point.tolist())
        context.console.say(f"placed at ({where}), scale {placed.target_from_object.scale:.3f}")
        context.console.say(_size(placed, self.options.scale, in_metres[0], in_metres[1]))
        context.console.tell(*placed.warnings)
        if (unseen := placed.coverage.unseen_share) > _MUCH_UNSEEN:
            write_image(folder / COVERAGE_FILE, placed.coverage.draw())
            text = (
                f"{unseen:.0%} of the target's images show a side of the object that none of its photos shows: red in "
                "the picture, seen from above; dark dots are its photos, blue ones the target's images."
            )
            remedy = "Turn the object (--yaw-deg), put it before a wall, or photograph that side of it too."
            context.console.tell(Note(text, "warning", remedy, picture=folder / COVERAGE_FILE))
        return Placement(objects=(ObjectPlacement(target_from_object=placed.target_from_object),))


def _size(placed: Placed, given: float | None, own: MetricScale | None, place: MetricScale | None) -> str:
    """Describe the object's size and the reason for it."""
    parts = []
    if own is not None:
        parts.append(f"{100 * own.metres_per_unit * placed.base.height:.3g} cm tall in its capture ({own.source})")
    if place is not None:
        height = 100 * place.metres_per_unit * placed.target_from_object.scale * placed.base.height
        parts.append(f"{height:.3g} cm tall in the target ({place.source})")
    if given is not None:
        why = "by the scale that was given"
    elif own is not None and place is not None:
        why = "as large as it was"
    else:
        missing = " and ".join(
            name for name, scale in (("the object's capture", own), ("the target's capture", place)) if scale is None
        )
        why = (
            f"a guess, a third of the pictures' height or less for lack of room, because the true size of {missing} is "
            "unknown: give it by splatgraft scale, or by --scale"
        )
    return f"size: {'; '.join([*parts, why])}"


COMMAND = Compose
