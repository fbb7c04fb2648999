"""The command `relight`: a composite becomes one whose object has the light of its new place."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from splatgraft.folders.composite_folder import placement_files, read_composite
from splatgraft.folders.selection_file import write_selection
from splatgraft.formats import read_cameras, read_gaussians, write_gaussians
from splatgraft.formats.placement import read_placement
from splatgraft.project.layout import IS_OBJECT_FILE, LIGHT_FILE, LIGHT_TEXT_FILE, SCENE_FILE
from splatgraft.project.step import Context, Inputs
from splatgraft.relighting.gain_transfer import relight_by_gain
from splatgraft.relighting.layers import LayerWeights
from splatgraft.relighting.light.light import Light, light_from_json, light_to_json
from splatgraft.relighting.transfer import RelightOptions, SourceScene, relight


@dataclass(frozen=True)
class Relight:
    """Give the object the light of its new place, and the place its shadow; no training, no views."""

    target: Path
    """The scene that receives the object, a .ply."""
    placement: Path
    """placement.json that names the objects: the one in the composite's folder."""
    cameras: Path
    """The target's cameras, a transforms.json: they tell what is up."""
    out: Path = Path("relit")
    """Folder for scene.ply, is_object.npy, light.json and the same in words, light.txt."""
    surroundings: Path | None = None
    """The source without the object that was taken from it, a .ply: the light that is to be taken off. Objects of other
    files, and all of them without it, keep their mean brightness."""
    object_cameras: Path | None = None
    """The source's cameras, a transforms.json."""
    taken: Path | None = None
    """That object's file, as the placement names it; the first object's where not given."""
    light: Literal["transfer", "gain", "off"] = "transfer"
    """transfer: shading and shadows; gain: exposure and white balance of the object alone; off: the object as it was
    captured (the paper's configuration)."""
    given_light: Path | None = None
    """A light.json, as an earlier run wrote it and you may have changed it; it takes the place of the estimate."""
    options: RelightOptions = field(default_factory=RelightOptions)
    weights: LayerWeights = field(default_factory=LayerWeights)

    def inputs(self) -> Inputs:
        """Scenes, placement and cameras."""
        source = tuple(path for path in (self.surroundings, self.object_cameras) if path is not None)
        placement = placement_files(self.placement)
        light = () if self.given_light is None else (self.given_light,)
        scenes = {"target": (self.target,), "placement": placement}
        return scenes | {"cameras": (self.cameras,), "source": source, "light": light}

    def write(self, folder: Path, context: Context) -> None:
        """Make the relit composite, and say in words what was found."""
        composite = read_composite(self.target, self.placement)
        found: Light | None = None
        if self.light == "off":
            gaussians, is_object = composite.bake()
            sentences = ("The light transfer was off: the object is pasted as it was captured.",)
        elif self.light == "gain":
            adjusted, sentences = relight_by_gain(composite, read_cameras(self.cameras), sources=self._sources())
            gaussians, is_object = adjusted.bake()
        else:
            cameras, sources = read_cameras(self.cameras), self._sources()
            relit = relight(composite, cameras, sources=sources, light=self._given(), options=self.options)
            found = relit.light
            (gaussians, is_object), sentences = relit.bake(self.weights), relit.report
        write_gaussians(folder / SCENE_FILE, gaussians)
        write_selection(folder / IS_OBJECT_FILE, is_object)
        (folder / LIGHT_TEXT_FILE).write_text("\n".join(sentences) + "\n")
        if found is not None:
            (folder / LIGHT_FILE).write_text(light_to_json(found))
        for sentence in sentences:
            context.console.say(sentence)

    def _given(self) -> Light | None:
        if self.given_light is None:
            return None
        if not self.given_light.is_file():
            raise ValueError(f"{self.given_light}: expected a light.json, found no such file")
        return light_from_json(self.given_light.read_text(), name=str(self.given_light))

    def _sources(self) -> list[SourceScene | None]:
        source = None
        if self.surroundings is not None:
            if self.object_cameras is None:
                raise ValueError("--surroundings: expected --object-cameras beside it, found none")
            source = SourceScene(read_gaussians(self.surroundings), read_cameras(self.object_cameras))
        paths = [item.object_path for item in read_placement(self.placement).objects]
        taken = self.taken or (paths[0] if paths else None)
        if taken is None:
            return [None] * len(paths)
        # copies of one object have one origin; of others none is known, and the report says so
        return [source if path is not None and path.resolve() == taken.resolve() else None for path in paths]


COMMAND = Relight
