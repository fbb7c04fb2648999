"""A folder of rendered views: one file per picture and camera, as `render` writes and later steps read them.

transforms.json  composite/NAME.png  background/  prior/  mask/  depth/NAME.npy
"""

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import read_mask, read_rgb, write_image
from splatgraft.formats import read_cameras, write_cameras
from splatgraft.harmonization import HarmonizerInputs
from splatgraft.project.layout import CAMERAS_FILE
from splatgraft.runtime.files import atomic_write

PICTURES = ("composite", "background", "prior", "mask", "depth")


def file_stems(cameras: Cameras) -> tuple[str, ...]:
    """Make a file name without suffix for each camera, of the camera's name and its last folder."""
    stems = tuple("_".join(PurePosixPath(name).with_suffix("").parts[-2:]) for name in cameras.names)
    stems = tuple(stem.removeprefix("images_") for stem in stems)
    if len(set(stems)) < len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise ValueError(f"cameras: expected names that differ, found {twice} twice")
    return stems


@dataclass(frozen=True)
class ViewFolder:
    """Pictures of a composite from all its cameras, read one view at a time."""

    folder: Path
    """Folder of the pictures."""
    cameras: Cameras
    """Camera of each view."""
    stems: tuple[str, ...]
    """File names of the views, without suffix."""

    @staticmethod
    def create(folder: Path, cameras: Cameras) -> "ViewFolder":
        """Make an empty folder of views for `cameras`."""
        for name in PICTURES:
            (folder / name).mkdir(parents=True, exist_ok=True)
        write_cameras(folder / CAMERAS_FILE, cameras)
        return ViewFolder(folder, cameras, file_stems(cameras))

    @staticmethod
    def open(folder: Path) -> "ViewFolder":
        """Open a folder that `create` and `write` made."""
        cameras = read_cameras(folder / CAMERAS_FILE)
        return ViewFolder(folder, cameras, file_stems(cameras))

    def __len__(self) -> int:
        return len(self.stems)

    def path(self, picture: str, index: int) -> Path:
        """Return the file of one picture of one view."""
        return self.folder / picture / f"{self.stems[index]}{'.npy' if picture == 'depth' else '.png'}"

    def files(self) -> tuple[Path, ...]:
        """List all files of the folder."""
        pictures = [self.path(name, i) for name in PICTURES for i in range(len(self))]
        return (self.folder / CAMERAS_FILE, *pictures)

    def write(self, index: int, view: HarmonizerInputs) -> None:
        """Write all pictures of one view."""
        for name in ("composite", "background", "prior", "mask"):
            write_image(self.path(name, index), getattr(view, name))
        with atomic_write(self.path("depth", index)) as stream:
            np.save(stream, view.depth.cpu().numpy().astype(np.float32))

    def read(self, index: int) -> HarmonizerInputs:
        """Read all pictures of one view."""
        composite, background, prior = (read_rgb(self.path(name, index)) for name in PICTURES[:3])
        depth = _read_depth(self.path("depth", index))
        mask = read_mask(self.path("mask", index))
        for name, picture in (("background", background), ("prior", prior), ("mask", mask), ("depth", depth)):
            if picture.shape[:2] != composite.shape[:2]:
                found = f"{picture.shape[1]}x{picture.shape[0]}"
                wanted = f"{composite.shape[1]}x{composite.shape[0]}"
                raise ValueError(f"{self.path(name, index)}: expected {wanted} pixels, found {found}")
        return HarmonizerInputs(
            composite=composite,
            background=background,
            mask=mask,
            depth=depth,
            prior=prior,
        )


def _read_depth(path: Path) -> Float[Tensor, "h w"]:
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"{path}: expected a depth map, found {type(error).__name__}: {error}") from error
    if array.ndim != 2 or array.dtype.kind != "f":
        raise ValueError(f"{path}: expected a two-dimensional array of floats, found {array.dtype} {array.shape}")
    return torch.from_numpy(array.astype(np.float32))
