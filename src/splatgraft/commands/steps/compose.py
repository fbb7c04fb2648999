"""The command `compose`: place an object in a target scene, by a placement or where the object fits."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from splatgraft.composition import PlaceOptions, place_object
from splatgraft.core.gaussians import Gaussians
from splatgraft.folders.capture_files import camera_files
from splatgraft.folders.composite_folder import composite_of, placement_files, write_composite
from splatgraft.formats import read_cameras, read_gaussians
from splatgraft.formats.placement import ObjectPlacement, Placement, read_placement
from splatgraft.project.step import Context, Inputs


@dataclass(frozen=True)
class Compose:
    """Place the object in the target: as placement.json says, or upright on the surface where it fits."""

    target: Path
    """The scene that receives the object, a .ply."""
    object: Path
    """The object's Gaussians, a .ply; a placement may name others beside it."""
    out: Path = Path("composite")
    """Folder for placement.json, which `relight` reads beside the target, and the same as scene.ply, is_object.npy."""
    placement: Path | None = None
    """placement.json; without it the object is rested on a surface, for which both captures' cameras are needed."""
    cameras: Path | None = None
    """The target's cameras, a capture folder or its transforms.json: from them follow the up direction and what is in
    view."""
    object_cameras: Path | None = None
    """The source's cameras, likewise."""
    surroundings: Path | None = None
    """The source without the object, a .ply: the surface that the object stood on gives the object's base."""
    options: PlaceOptions = field(default_factory=PlaceOptions)

    def inputs(self) -> Inputs:
        """The scenes, and the placement with its files or the cameras."""
        scenes = {"target": (self.target,), "object": (self.object,)}
        if self.placement is not None:
            return scenes | {"placement": placement_files(self.placement)}
        named = [path for path in (self.cameras, self.object_cameras) if path is not None]
        cameras = tuple(file for path in named for file in camera_files(path))
        return scenes | {"cameras": cameras + (() if self.surroundings is None else (self.surroundings,))}

    def write(self, folder: Path, context: Context) -> None:
        """Compose and write the scene."""
        target, object_ = read_gaussians(self.target), read_gaussians(self.object)
        placement = self._found(target, object_, context) if self.placement is None else read_placement(self.placement)
        named = tuple(replace(item, object_path=item.object_path or self.object) for item in placement.objects)
        placement = replace(placement, objects=named)
        write_composite(folder, composite_of(target, placement, known={self.object: object_}), placement)

    def _found(self, target: Gaussians, object_: Gaussians, context: Context) -> Placement:
        """The placement on a level surface of the target."""
        if self.cameras is None or self.object_cameras is None:
            raise ValueError(
                "compose: expected --placement, or --cameras and --object-cameras to find a place, found neither"
            )
        cameras = (read_cameras(self.cameras), read_cameras(self.object_cameras))
        surroundings = None if self.surroundings is None else read_gaussians(self.surroundings)
        placed = place_object(target, object_, cameras=cameras, surroundings=surroundings, options=self.options)
        where = ", ".join(f"{x:.3f}" for x in placed.support.point.tolist())
        context.console.say(f"placed at ({where}), scale {placed.target_from_object.scale:.3f}")
        for warning in placed.warnings:
            context.console.warn(warning)
        return Placement(objects=(ObjectPlacement(target_from_object=placed.target_from_object),))


COMMAND = Compose
