"""A folder of rendered views: one file per picture and camera, as `render` writes and later steps read them.

transforms.json  composite/NAME.png  background/  prior/  mask/  normal/NAME.png  depth/NAME.npy
prior.json       confidence of the light in prior/, 0 to 1, as "trust"
"""

import json
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import read_mask, read_rgb, write_image
from splatgraft.formats import read_cameras, write_cameras
from splatgraft.formats.json_file import load, number
from splatgraft.harmonization import HarmonizerInputs
from splatgraft.project.layout import CAMERAS_FILE
from splatgraft.runtime.files import atomic_write

_PRIOR_FILE = "prior.json"
PICTURES = ("composite", "background", "prior", "mask", "normal", "depth")


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
    def create(folder: Path, cameras: Cameras, *, prior_confidence: float = 0.0) -> "ViewFolder":
        """Make an empty folder of views for `cameras`; `prior_confidence`, in [0, 1], is of the priors' light."""
        for name in PICTURES:
            (folder / name).mkdir(parents=True, exist_ok=True)
        write_cameras(folder / CAMERAS_FILE, cameras)
        (folder / _PRIOR_FILE).write_text(json.dumps({"trust": round(prior_confidence, 4)}) + "\n")
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
        return (self.folder / CAMERAS_FILE, *pictures, self.folder / _PRIOR_FILE)

    def write(self, index: int, view: HarmonizerInputs) -> None:
        """Write all pictures of one view."""
        for name in ("composite", "background", "prior", "mask"):
            write_image(self.path(name, index), getattr(view, name))
        write_image(self.path("normal", index), view.normal * 0.5 + 0.5)
        with atomic_write(self.path("depth", index)) as stream:
            np.save(stream, view.depth.cpu().numpy().astype(np.float32))

    def read(self, index: int) -> HarmonizerInputs:
        """Read all pictures of one view."""
        composite, background, prior = (read_rgb(self.path(name, index)) for name in PICTURES[:3])
        depth = _read_depth(self.path("depth", index))
        normal = _normal_from_rgb(read_rgb(self.path("normal", index)))
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
            normal=normal,
            prior=prior,
            prior_confidence=self._prior_confidence(),
            camera_from_world=self.cameras.camera_from_world[index, :3, :3],
        )

    def _prior_confidence(self) -> float:
        """Read the confidence of the priors' light."""
        path = self.folder / _PRIOR_FILE
        return number(path, load(path), "trust")


def _normal_from_rgb(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Decode unit normals of 8-bit pictures; grey, which means no surface, becomes zero."""
    normal = image * 2 - 1
    length = normal.norm(dim=-1, keepdim=True)
    # rounding moves grey from 0, and a normal from length 1, by at most half a level per channel
    return torch.where(length > 0.5, normal / length.clamp_min(0.5), 0.0)


def _read_depth(path: Path) -> Float[Tensor, "h w"]:
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"{path}: expected a depth map, found {type(error).__name__}: {error}") from error
    if array.ndim != 2 or array.dtype.kind != "f":
        raise ValueError(f"{path}: expected a two-dimensional array of floats, found {array.dtype} {array.shape}")
    return torch.from_numpy(array.astype(np.float32))
