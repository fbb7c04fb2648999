"""8-bit image pyramids of a capture's photographs: the first steps of a fit use the coarse levels."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import resize
from splatgraft.core.posed_images import PosedImages
from splatgraft.runtime.progress import Progress

_SMALLEST = 32
"""Least side of a reduced image, pixels: below it the 11-pixel window of SSIM covers most of the image."""


@dataclass(frozen=True)
class Level:
    """All photographs at one size."""

    until: float
    """Share of the steps after which the next level is used."""
    cameras: tuple[Cameras, ...]
    """One batch of 1 per photograph, at the level's size."""
    images: tuple[UInt8[Tensor, "_ _ 3"], ...]
    """sRGB times 255."""


@dataclass(frozen=True)
class Pyramid:
    """`fitting.Views` of photographs, from coarse to fine."""

    levels: tuple[Level, ...]
    """From coarse to fine."""

    def __len__(self) -> int:
        """Number of views."""
        return len(self.levels[0].images)

    def at(self, index: int, done: float) -> tuple[Cameras, Float[Tensor, "h w 3"]]:
        """Camera and photograph `index` at the level for the share `done` of all steps."""
        level = next((level for level in self.levels if done < level.until), self.levels[-1])
        return level.cameras[index], level.images[index].float() / 255


def read_pyramid(
    capture: PosedImages, schedule: Sequence[tuple[float, float]], *, device: str, progress: Progress
) -> Pyramid:
    """Read every photograph once into all levels; `schedule` has (factor, until) per level, from coarse to fine."""
    cameras: list[list[Cameras]] = [[] for _ in schedule]
    images: list[list[Tensor]] = [[] for _ in schedule]
    for i in range(len(capture)):
        photograph = capture.image(i)
        camera = capture.cameras[i].to(device)
        for level, (factor, _) in enumerate(schedule):
            smallest = min(1.0, _SMALLEST / min(camera.sizes[0].tolist()))
            reduced = camera.resized(max(factor, smallest))
            width, height = reduced.sizes[0].tolist()
            cameras[level].append(reduced)
            images[level].append((resize(photograph, width, height) * 255).round().to(torch.uint8).to(device))
        progress(i + 1, len(capture), "reading photographs")
    return Pyramid(
        tuple(Level(until, tuple(c), tuple(p)) for (_, until), c, p in zip(schedule, cameras, images, strict=True))
    )
