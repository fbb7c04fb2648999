"""8-bit image pyramids of a capture's photographs, and the pixels that a step of the fit uses.

The first steps use a coarse level. Later ones may use every n-th pixel of the photograph, with another first pixel at
every visit. Their low pass is that of the full photograph, so the gradient is an estimate of that of all pixels at a
fraction of the cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import resize
from splatgraft.core.posed_images import PosedImages
from splatgraft.fitting.gaussian_fit import MIN_SIDE_PX, View
from splatgraft.reconstruction.options import Sampling
from splatgraft.runtime.progress import Progress


@dataclass(frozen=True)
class Level:
    """All photographs at one size."""

    sampling: Sampling
    """Size of the level, pixels that are fitted, and share of the steps at which the level ends."""
    cameras: tuple[Cameras, ...]
    """One batch of 1 per photograph, at the level's size."""
    images: tuple[UInt8[Tensor, "_ _ 3"], ...]
    """Photographs, sRGB times 255."""


@dataclass(frozen=True)
class Pyramid:
    """Photographs of a capture at several sizes, from coarse to fine."""

    levels: tuple[Level, ...]

    def __len__(self) -> int:
        """Number of views."""
        return len(self.levels[0].images)

    def reduced(self, longest_side_px: int) -> tuple[list[Cameras], list[Float[Tensor, "_ _ 3"]]]:
        """Return cameras and images of the coarsest level on the CPU, reduced to the given longest side."""
        cameras, images = [], []
        for camera, image in zip(self.levels[0].cameras, self.levels[0].images, strict=True):
            small = camera.to("cpu").resized(min(1.0, longest_side_px / int(camera.sizes.max())))
            cameras.append(small)
            images.append(resize(image.cpu().float() / 255, small.width, small.height))
        return cameras, images

    def at(self, index: int, *, visit: int, done: float) -> View:
        """Return view `index` at its visit number `visit` (from 0), after the share `done` in [0, 1] of all steps."""
        level = next((level for level in self.levels if done < level.sampling.until), self.levels[-1])
        view = View(level.cameras[index], level.images[index])
        return view.every_nth(level.sampling.stride, visit=visit, index=index)


def read_pyramid(capture: PosedImages, schedule: Sequence[Sampling], *, device: str, progress: Progress) -> Pyramid:
    """Read every photograph once into all levels; `schedule` goes from coarse to fine."""
    cameras: list[list[Cameras]] = [[] for _ in schedule]
    images: list[list[Tensor]] = [[] for _ in schedule]
    for i in range(len(capture)):
        photograph = capture.image(i)
        camera = capture.cameras[i].to(device)
        for level, sampling in enumerate(schedule):
            smallest = min(1.0, MIN_SIDE_PX / min(camera.sizes[0].tolist()))
            reduced = camera.resized(max(sampling.factor, smallest))
            width, height = reduced.sizes[0].tolist()
            cameras[level].append(reduced)
            images[level].append((resize(photograph, width, height) * 255).round().to(torch.uint8).to(device))
        progress(i + 1, len(capture), "reading photographs")
    return Pyramid(
        tuple(Level(sampling, tuple(c), tuple(p)) for sampling, c, p in zip(schedule, cameras, images, strict=True))
    )
