"""A project so small that every step takes a second: a ball on a plane, photographed by our own renderer."""

import hashlib
import math
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import shapes
import torch

from splatgraft.cli import main
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.formats import write_capture
from splatgraft.rendering import render

OPTIONS = """
[reconstruct]
iterations = 60
budget = 400
sh_degree = 1

[segment]
threshold = 0.5
solidify = 4

[compose]
point = [0.0, 0.0, 0.5]
scale = 0.8

[relight]
light = "off"

[consolidate]
passes = 1

[evaluate]
pictured = 2
frames = 3
"""


def blobs(means: torch.Tensor, color: tuple[float, float, float], size: float) -> Gaussians:
    n = len(means)
    even = shapes.blobs(means, size, srgb=color)
    return replace(even, sh=even.sh + 0.2 * torch.rand(n, 1, 3, generator=torch.Generator().manual_seed(n)))


def plane(color: tuple[float, float, float]) -> Gaussians:
    x, y = torch.meshgrid(torch.linspace(-1, 1, 12), torch.linspace(-1, 1, 12), indexing="ij")
    flat = blobs(torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3), color, 0.12)
    return replace(flat, log_scales=torch.tensor([0.12, 0.12, 0.01]).log().repeat(flat.count, 1))


def ball() -> Gaussians:
    points = torch.nn.functional.normalize(torch.randn(80, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    return blobs(0.25 * points + torch.tensor([0, 0, 0.3]), (0.8, 0.2, 0.1), 0.07)


def photograph(
    folder: Path,
    scene: Gaussians,
    object_: Gaussians | None,
    around_deg: float = 360.0,
    *,
    width: int = 48,
    views: int = 8,
) -> None:
    """Write a capture of `scene` by cameras of 48x36 pixels or larger, with masks of `object_` if it is given."""
    angles = torch.arange(views) * math.radians(around_deg / views)
    eyes = torch.stack([1.6 * angles.cos(), 1.6 * angles.sin(), torch.full((views,), 1.0)], 1)
    poses = look_at(eyes, torch.tensor([0.0, 0, 0.15]), torch.tensor([0.0, 0, 1]))
    cameras = pinhole(poses, 45.0 / 48 * width, width=width, height=36 * width // 48)
    whole = scene if object_ is None else concatenate([scene, object_])
    pictures = render(whole, cameras, features=(torch.arange(whole.count) >= scene.count)[:, None].float())
    for name in ("images", "masks") if object_ is not None else ("images",):
        (folder / name).mkdir(parents=True)
    for index, name in enumerate(cameras.names):
        write_image(folder / "images" / f"{name}.png", pictures.color[index])
        if object_ is not None:
            write_image(folder / "masks" / f"{name}.png", (pictures.features[index, ..., 0] > 0.5).float())
    write_capture(
        folder,
        PosedImages(
            image_paths=tuple(folder / "images" / f"{name}.png" for name in cameras.names),
            cameras=cameras,
            points=whole.means,
            point_colors=(0.5 + 0.28209479 * whole.sh[:, 0]).clamp(0, 1),
        ),
    )


def write_project(root: Path, options: str = OPTIONS) -> Path:
    """Write two captures and a project.toml, and return the file."""
    photograph(root / "photos" / "source", plane((0.3, 0.5, 0.3)), ball())
    photograph(root / "photos" / "target", plane((0.5, 0.45, 0.6)), None)
    path = root / "project" / "project.toml"
    path.parent.mkdir()
    captures = '[source]\ncapture = "../photos/source"\n[target]\ncapture = "../photos/target"\n'
    path.write_text(captures + options)
    return path


def finish_project(root: Path) -> Path:
    """Write two captures and a project with all results, and return its folder."""
    path = write_project(root)
    assert main(["run", str(path)]) == 0
    return path.parent


def copy_of(project: Path, root: Path) -> Path:
    """Copy a project and the captures beside it with its steps equally up to date, and return its folder in `root`."""
    for name in ("photos", project.name):
        shutil.copytree(project.parent / name, root / name)
    return root / project.name


def contents(folder: Path) -> dict[str, str]:
    """Return hashes of all files of a result except step.json, by path."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "step.json"]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


if __name__ == "__main__":
    # compiles most kernels, which otherwise both workers of `.ci/run` would do
    with tempfile.TemporaryDirectory() as folder:
        file = finish_project(Path(folder)) / "project.toml"
        file.write_text(file.read_text().replace('light = "off"', 'light = "transfer"'))
        main(["run", str(file), "--to", "relight"])
