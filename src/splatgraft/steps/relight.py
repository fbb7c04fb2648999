"""The command `relight`: light the objects of a composite by the target scene, and add their shadows to it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal

import torch

from splatgraft.compositing.composite import Composite
from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.images import write_image
from splatgraft.folders.capture_files import camera_files
from splatgraft.folders.clock_sun import clock_sun_path, read_clock_sun
from splatgraft.folders.composite_folder import placement_files, read_composite
from splatgraft.formats import read_cameras, read_gaussians, write_gaussians
from splatgraft.project.gaussian_flags import write_flags
from splatgraft.project.layout import IS_OBJECT_FILE, LIGHT_FILE, LIGHT_PICTURE, LIGHT_TEXT_FILE, SCENE_FILE
from splatgraft.project.placement import read_placement
from splatgraft.project.step import Context, Inputs
from splatgraft.relighting.layers import LayerWeights, Relit
from splatgraft.relighting.light.light import Light, light_from_json, light_to_json
from splatgraft.relighting.prepared_object import SourceScene
from splatgraft.relighting.report import draw_light
from splatgraft.relighting.transfer import RelightOptions, relight
from splatgraft.runtime.note import Note


@dataclass(frozen=True)
class Relight:
    """Light the object by its new place and add its shadow to the place; no training, no images."""

    remedy: ClassVar[str] = (
        "turn the arrow of the light to where the light comes from: splatgraft edit PROJECT, step Light"
    )

    target: Path
    """The scene that receives the object, a .ply."""
    placement: Path
    """placement.json in the composite's folder; it names the objects. The composite's scene.ply is not read."""
    cameras: Path
    """The target's cameras, a capture folder or its transforms.json; they give the up direction."""
    out: Path = Path("relit")
    """Folder for scene.ply, is_object.npy, light.json, light.txt (the light in words), light.png and source_light_N.png
    (pictures of the lights)."""
    surroundings: Path | None = None
    """The source without its object, a .ply; the light on the object at capture is estimated from it and divided out.
    Objects of other files, and all objects if it is not given, keep their mean brightness."""
    object_cameras: Path | None = None
    """The source's cameras, likewise."""
    taken: Path | None = None
    """File of the object that was taken from the source, as the placement names it; the first one if not given."""
    light: Literal["transfer", "off"] = "transfer"
    """transfer: shading and shadows; off: the object as it was captured (the paper's configuration)."""
    given_light: Path | None = None
    """A light.json that replaces the estimate, such as an edited one of an earlier run."""
    options: RelightOptions = field(default_factory=RelightOptions)
    weights: LayerWeights = field(default_factory=LayerWeights)

    def inputs(self) -> Inputs:
        """Return the scenes, the placement, the cameras and the given light."""
        source = () if self.surroundings is None else (self.surroundings,)
        source += () if self.object_cameras is None else camera_files(self.object_cameras)
        placement = placement_files(self.placement)
        light = () if self.given_light is None else (self.given_light,)
        clocks = (clock_sun_path(path) for path in (self.cameras, self.object_cameras) if path is not None)
        scenes = {"target": (self.target,), "placement": placement, "clock": tuple(filter(Path.is_file, clocks))}
        return scenes | {"cameras": camera_files(self.cameras), "source": source, "light": light}

    def write(self, folder: Path, context: Context) -> None:
        """Relight, write the scene and the light, and print the report."""
        composite = read_composite(self.target, self.placement)
        found: Light | None = None
        if self.light == "off":
            gaussians, is_object = composite.bake()
            notes = (Note("The light transfer was off: the object is pasted as it was captured."),)
        else:
            cameras, sources = read_cameras(self.cameras), self.sources()
            clock = read_clock_sun(self.cameras)
            relit = relight(composite, cameras, sources=sources, light=self.given(), clock=clock, options=self.options)
            found = relit.light
            gaussians, is_object = relit.bake(self.weights)
            notes = relit.report
            _draw_lights(folder, relit, composite, sources)
            if clock is not None:  # not among the notes: light.txt is part of the report, which can be shared
                context.console.say(f"By the clock of the target's photos: {clock.describe(cameras)}.")
        write_gaussians(folder / SCENE_FILE, gaussians)
        write_flags(folder / IS_OBJECT_FILE, is_object)
        (folder / LIGHT_TEXT_FILE).write_text("".join(f"{note.text}\n" for note in notes), encoding="utf-8")
        if found is not None:
            (folder / LIGHT_FILE).write_text(light_to_json(found), encoding="utf-8")
        picture = folder / LIGHT_PICTURE
        context.console.tell(*(replace(note, picture=picture if picture.is_file() else None) for note in notes))

    def given(self) -> Light | None:
        """Read the light that replaces the estimate; None if none is given."""
        if self.given_light is None:
            return None
        if not self.given_light.is_file():
            raise ValueError(f"{self.given_light}: expected a light.json, found no such file")
        return light_from_json(self.given_light.read_text(encoding="utf-8"), name=str(self.given_light))

    def sources(self) -> list[SourceScene | None]:
        """Read the scene that each object was taken from; None if it is not known."""
        source = None
        if self.surroundings is not None:
            if self.object_cameras is None:
                raise ValueError("--surroundings: expected --object-cameras beside it, found none")
            source = SourceScene(
                read_gaussians(self.surroundings),
                read_cameras(self.object_cameras),
                clock=read_clock_sun(self.object_cameras),
            )
        paths = [item.object_path for item in read_placement(self.placement).objects]
        taken = self.taken or (paths[0] if paths else None)
        if taken is None:
            return [None] * len(paths)
        # all copies of the object have this source; objects of other files have none, as the report says
        return [source if path is not None and path.resolve() == taken.resolve() else None for path in paths]


def _draw_lights(folder: Path, relit: Relit, composite: Composite, sources: Sequence[SourceScene | None]) -> None:
    """Write pictures of the estimated lights: at the new place, and at the old place of each object."""
    if relit.estimate is not None and relit.objects:
        center = torch.stack([bounding_sphere(one).center for one in relit.objects]).mean(0)
        write_image(folder / LIGHT_PICTURE, draw_light(relit.estimate, composite.target, center))
    for one in relit.prepared:
        source, lighting = sources[one.number - 1], one.source_lighting
        if source is not None and lighting is not None and lighting.estimate is not None:
            center = bounding_sphere(composite.objects[one.number - 1].gaussians).center
            picture = draw_light(lighting.estimate, source.gaussians, center)
            write_image(folder / f"source_light_{one.number}.png", picture)


COMMAND = Relight
