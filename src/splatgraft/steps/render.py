"""The command `render`: pictures of a scene, or all input pictures of a harmoniser for a composite."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.folders.capture_files import camera_files
from splatgraft.folders.view_folder import ViewFolder, file_stems
from splatgraft.formats import read_cameras, read_gaussians, write_capture
from splatgraft.harmonization import render_views
from splatgraft.project.gaussian_flags import read_selection
from splatgraft.project.step import Context, Device, Inputs, choose_device
from splatgraft.rendering import RenderOptions, render


@dataclass(frozen=True)
class Render:
    """Render a scene from given cameras; with --is-object and --prior, all input pictures of a harmoniser."""

    scene: Path
    """The scene, or the composite, a .ply."""
    cameras: Path
    """A transforms.json, or any capture folder."""
    out: Path = Path("views")
    """Folder for the pictures; for a plain scene it is a capture with images/ and transforms.json."""
    is_object: Path | None = None
    """is_object.npy of a composite: also write background/, mask/ and depth/."""
    prior: Path | None = None
    """The relit composite, a .ply, for prior/; the composite itself if not given."""
    eval: bool = False
    """Leave out every 8th camera, so that `evaluate` has views that no later step has seen."""
    low_pass: Literal["classic", "antialiased"] = "classic"
    """Screen filter that the scene was trained with: `antialiased` for mip-splatting and gsplat's antialiased mode."""
    device: Device = "auto"
    """Device to compute on."""

    def inputs(self) -> Inputs:
        """Return the scenes and the cameras."""
        optional = {"is_object": self.is_object, "prior": self.prior}
        given = {role: (path,) for role, path in optional.items() if path is not None}
        return {"scene": (self.scene,), "cameras": camera_files(self.cameras), **given}

    def write(self, folder: Path, context: Context) -> None:
        """Render and write one camera at a time."""
        device = choose_device(self.device, context.console)
        scene, cameras = read_gaussians(self.scene).to(device), read_cameras(self.cameras).to(device)
        if self.eval:
            cameras = cameras[~held_out(len(cameras))]
        options = RenderOptions(low_pass=self.low_pass)
        if self.is_object is None:
            return _render_plain(scene, cameras, folder=folder, options=options, context=context)
        is_object = read_selection(self.is_object, scene.count, self.scene).to(device)
        prior = None if self.prior is None else read_gaussians(self.prior).to(device)
        views = ViewFolder.create(folder, cameras.to("cpu"))
        for index, view in enumerate(render_views(scene, is_object, cameras, prior=prior, options=options)):
            views.write(index, view)
            context.progress(index + 1, len(cameras), views.stems[index])


def _render_plain(
    scene: Gaussians, cameras: Cameras, *, folder: Path, options: RenderOptions, context: Context
) -> None:
    (folder / "images").mkdir()
    paths = tuple(folder / "images" / f"{stem}.png" for stem in file_stems(cameras))
    for index, camera in enumerate(cameras):
        write_image(paths[index], render(scene, camera, options=options).color[0].cpu().clamp(0, 1))
        context.progress(index + 1, len(cameras), paths[index].name)
    none = torch.zeros(0, 3)
    write_capture(folder, PosedImages(image_paths=paths, cameras=cameras.to("cpu"), points=none, point_colors=none))


COMMAND = Render
