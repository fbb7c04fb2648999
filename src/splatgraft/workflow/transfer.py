"""The whole transfer in a single Python call, which writes and runs a project and returns its result."""

import json
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from splatgraft.compositing.composite import Composite
from splatgraft.composition import PlaceOptions, place_object
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.posed_images import PosedImages
from splatgraft.exports.export import ExportOptions, export_scene
from splatgraft.exports.export_source import ExportSource
from splatgraft.exports.notebook import frame_of, picture_of
from splatgraft.folders.clock_sun import read_clock_sun
from splatgraft.folders.composite_folder import read_composite
from splatgraft.folders.export_source import read_export_source
from splatgraft.folders.input_description import require_input
from splatgraft.formats import is_scene, read_cameras, write_capture, write_gaussians
from splatgraft.project.layout import EXPORTS_FOLDER, LIGHT_FILE, PROJECT_FILE
from splatgraft.project.step import plain_options
from splatgraft.project.toml_edit import with_keys
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.relighting import Light, RelightOptions, SourceScene, light_from_json, light_to_json
from splatgraft.relighting.transfer import TransferValues
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.process import open_page
from splatgraft.steps.relight import Relight
from splatgraft.workflow.flow import read_flow
from splatgraft.workflow.run import run_project

_HEAD = "# Written by splatgraft.transfer, which replaces it when it is called again with this project.\n"
Given = Path | str | PosedImages | Gaussians


def transfer(
    source: Given,
    target: Given,
    *,
    at: tuple[float, float, float] | None = None,
    quality: str | ReconstructOptions = "draft",
    light: Light | None = None,
    project: Path | str | None = None,
) -> "Transfer":
    """Move the object of one capture or scene into another, with the steps of the command `run`.

    Args:
        source: The capture with the object: a path of photos, a video or a posed capture, or its value; or a trained
            scene, as a path or as Gaussians, of which virtual cameras take pictures.
        target: The capture or scene that receives it.
        at: Point of the target on whose surface the object is rested, world units; None finds a place.
        quality: Quality of the reconstruction, or all its options.
        light: The light at the object's new place; None to estimate it from the target.
        project: Folder of the results; a new temporary one if None. A later call with it repeats only what changed.

    Returns:
        The result, with the scene before it.

    Raises:
        ValueError: An input is bad, no place is free, or the folder holds another project.
    """
    root = Path(tempfile.mkdtemp(prefix="splatgraft_")) if project is None else Path(project)
    file = root / PROJECT_FILE
    if file.exists() and not file.read_text("utf-8").startswith(_HEAD):
        raise ValueError(f"{file}: expected no project, or one that transfer wrote; found another")
    (root / "given").mkdir(parents=True, exist_ok=True)
    text = _HEAD
    for side, given in (("source", source), ("target", target)):
        path = _path_of(given, root / "given" / side)
        text += f"\n[{side}]\n{'scene' if is_scene(path) else 'capture'} = {json.dumps(str(path.resolve()))}\n"
    options = {"quality": quality} if isinstance(quality, str) else plain_options(vars(quality))
    text = with_keys(text, "reconstruct", options)
    if at is not None:
        text = with_keys(text, "compose", {"point": [float(v) for v in at]})
    if light is not None:
        with atomic_write(root / "given" / "light.json") as stream:
            stream.write(light_to_json(light).encode())
        text = with_keys(text, "relight", {"given_light": "given/light.json"})
    with atomic_write(file) as stream:
        stream.write(text.encode())
    run_project(root, to="consolidate")
    step = read_flow(root).typed(Relight)
    found = step.out / LIGHT_FILE
    return Transfer(
        project=root,
        result=read_export_source(root),
        composite=read_composite(step.target, step.placement),
        cameras=read_cameras(step.cameras),
        sources=tuple(step.sources()),
        light=light_from_json(found.read_text("utf-8"), name=str(found)) if found.is_file() else None,
        values=TransferValues(lambda: read_clock_sun(step.cameras)),
    )


def _path_of(given: Given, folder: Path) -> Path:
    """Return a given path, or write a value to `folder` (.ply for a scene) and return that."""
    if isinstance(given, Gaussians):
        path = folder.with_suffix(".ply")
        write_gaussians(path, given.to("cpu"))
        return path
    if isinstance(given, PosedImages):
        folder.mkdir(exist_ok=True)
        write_capture(folder, given)
        return folder
    require_input(Path(given))
    return Path(given)


@dataclass(frozen=True, eq=False)
class Transfer:
    """The result of `transfer`, with the values to move or light the object again."""

    project: Path
    """Folder of all results; `splatgraft edit` and `splatgraft run` accept it."""
    result: ExportSource
    """The relit scene and the scenes before it."""
    composite: Composite
    """The target with the object placed in it, before the light transfer."""
    cameras: Cameras
    """The target's cameras."""
    sources: tuple[SourceScene | None, ...]
    """The scene that each object was taken from."""
    light: Light | None
    """Light at the object's place; None if none was found."""
    values: TransferValues
    """Values of the last light transfer, which `moved` takes again."""

    @property
    def scene(self) -> Gaussians:
        """The target with the relit object and its shadow."""
        return self.result.scene

    def moved(self, at: tuple[float, float, float] | None = None, *, light: Light | None = None) -> "Transfer":
        """Rest the object elsewhere, or light it by another light, as the editor's draft does.

        The first call estimates the light; further ones keep its sources while the object stays near.

        Args:
            at: Point of the target on whose surface the object is rested, world units; None keeps the place.
            light: The light at the object's place; None takes the estimate.

        Returns:
            The result, which is not written to the project.
        """
        composite, (placed,), (source,) = self.composite, self.composite.objects, self.sources
        if at is not None:
            assert source is not None
            found = place_object(
                composite.target,
                placed.gaussians,
                cameras=(self.cameras, source.cameras),
                surroundings=source.gaussians,
                options=PlaceOptions(at, scale=placed.target_from_object.scale),
            )
            composite = replace(composite, objects=(replace(placed, target_from_object=found.target_from_object),))
        draft = RelightOptions(most_added=0.0, fitted_views=0)
        relit = self.values.relight(
            composite, self.cameras, sources=self.sources, light=light, options=draft, exact=False
        )
        scene, is_object = relit.bake()
        result = replace(self.result, scene=scene, is_object=is_object, pasted=composite.bake()[0])
        return replace(self, composite=composite, result=result, light=relit.light)

    def save(self, path: Path | str, options: ExportOptions = ExportOptions()) -> None:
        """Write the result to a file whose suffix names the format, such as .ply, .html, .sog, .glb, .png or .mp4."""
        console = Console()
        with console.bar("export") as progress:
            said = export_scene(self.result, Path(path), options, progress=progress)
        for sentence in said:
            console.say(f"{path}: {sentence}")

    def show(self, *, height: int = 520) -> None:
        """Show a page with before and after: below a notebook's cell, `height` pixels high, else in the browser."""
        page = self.project / EXPORTS_FOLDER / "show.html"
        page.parent.mkdir(exist_ok=True)
        export_scene(self.result, page)
        shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
        if hasattr(shell, "kernel"):
            from IPython.display import HTML, display

            display(HTML(frame_of(page, height=height)))
        elif not open_page(page):
            print(page)

    def __repr__(self) -> str:
        return f"Transfer({self.composite}, {self.light or 'no light'}, project {self.project})"

    def _repr_png_(self) -> bytes | None:
        return picture_of(self.result)
