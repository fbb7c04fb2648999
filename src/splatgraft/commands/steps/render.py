"""The command `render`: pictures of a scene, or of a composite with all that a harmoniser wants to see."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.folders.selection_file import read_selection
from splatgraft.folders.view_folder import ViewFolder, file_stems
from splatgraft.formats import read_cameras, read_gaussians, write_capture
from splatgraft.harmonization import HarmonizerInputs
from splatgraft.project.layout import LIGHT_FILE
from splatgraft.project.step import Context, Device, Inputs, choose_device
from splatgraft.relighting.light.confidence import light_confidence
from splatgraft.relighting.light.light import light_from_json
from splatgraft.rendering import RenderOptions, render
from splatgraft.rendering.interface import Output


@dataclass(frozen=True)
class Render:
    """Render a scene from given cameras; with --is-object and --prior, all pictures of a composite."""

    scene: Path
    """The scene, or the composite, a .ply."""
    cameras: Path
    """A transforms.json, or any capture folder."""
    out: Path = Path("views")
    """Folder for the pictures. Of a plain scene it is a capture: images/ and transforms.json."""
    is_object: Path | None = None
    """is_object.npy of a composite: also write background/, mask/, depth/ and normal/."""
    prior: Path | None = None
    """The relit composite: what prior/ shows; the composite itself where not given."""
    eval: bool = False
    """Leave out every 8th camera, so that `evaluate` has views that no later step has seen."""
    low_pass: Literal["classic", "antialiased"] = "classic"
    """As the scene was trained: mip-splatting and gsplat's antialiased mode want `antialiased`."""
    device: Device = "auto"
    """Where to compute."""

    def inputs(self) -> Inputs:
        """Scenes and cameras."""
        cameras = self.cameras / "transforms.json" if self.cameras.is_dir() else self.cameras
        optional = {"is_object": self.is_object, "prior": self.prior}
        given = {role: (path,) for role, path in optional.items() if path is not None}
        if (light := self._light()) is not None:
            given["light"] = (light,)
        return {"scene": (self.scene,), "cameras": (cameras,), **given}

    def _light(self) -> Path | None:
        """The light that `relight` wrote beside the prior."""
        path = None if self.prior is None else self.prior.parent / LIGHT_FILE
        return path if path is not None and path.is_file() else None

    def _prior_confidence(self) -> float:
        path = self._light()
        return 0.0 if path is None else light_confidence(light_from_json(path.read_text(), name=str(path)))

    def write(self, folder: Path, context: Context) -> None:
        """Make the pictures, one camera at a time."""
        device = choose_device(self.device, context.console)
        scene, cameras = read_gaussians(self.scene).to(device), read_cameras(self.cameras).to(device)
        if self.eval:
            cameras = cameras[~held_out(len(cameras))]
        options = RenderOptions(low_pass=self.low_pass)
        if self.is_object is None:
            return _render_plain(scene, cameras, folder=folder, options=options, context=context)
        is_object = read_selection(self.is_object, scene.count, self.scene).to(device)
        prior = scene if self.prior is None else read_gaussians(self.prior).to(device)
        views = ViewFolder.create(folder, cameras.to("cpu"), prior_confidence=self._prior_confidence())
        for index, camera in enumerate(cameras):
            views.write(index, view_of(scene, is_object, prior=prior, camera=camera, options=options))
            context.progress(index + 1, len(cameras), views.stems[index])


def view_of(
    composite: Gaussians,
    is_object: Tensor,
    *,
    prior: Gaussians,
    camera: Cameras,
    options: RenderOptions = RenderOptions(),
    prior_confidence: float = 0.0,
) -> HarmonizerInputs:
    """What a harmoniser sees of one view of a composite, on the CPU."""
    outputs: frozenset[Output] = frozenset({"color", "depth", "normal"})
    coverage = is_object[:, None].float()
    full = render(composite, camera, outputs=outputs, features=coverage, options=options)
    assert full.depth is not None
    assert full.normal is not None
    assert full.features is not None
    color = _color(full.color)
    return HarmonizerInputs(
        composite=color,
        background=_color(render(composite.select(~is_object), camera, options=options).color),
        mask=full.features[0, ..., 0].cpu().clamp(0, 1),
        depth=full.depth[0].cpu(),
        normal=full.normal[0].cpu(),
        prior=color if prior is composite else _color(render(prior, camera, options=options).color),
        prior_confidence=prior_confidence,
        camera_from_world=camera.camera_from_world[0, :3, :3].cpu(),
    )


def _render_plain(
    scene: Gaussians, cameras: Cameras, *, folder: Path, options: RenderOptions, context: Context
) -> None:
    (folder / "images").mkdir()
    paths = tuple(folder / "images" / f"{stem}.png" for stem in file_stems(cameras))
    for index, camera in enumerate(cameras):
        write_image(paths[index], _color(render(scene, camera, options=options).color))
        context.progress(index + 1, len(cameras), paths[index].name)
    none = torch.zeros(0, 3)
    write_capture(folder, PosedImages(image_paths=paths, cameras=cameras.to("cpu"), points=none, point_colors=none))


def _color(color: Float[Tensor, "1 h w 3"] | None) -> Float[Tensor, "h w 3"]:
    assert color is not None
    return color[0].cpu().clamp(0, 1)


COMMAND = Render
