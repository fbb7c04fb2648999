"""A photo of a capture on the canvas, with clicks on the object and beside it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import PurePath

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.prompts import ViewPrompt

_NEAR = 0.012
"""A click within this distance of a point, over the photo's longer side, removes it."""
_BACKGROUND = 24
"""Grey beside the photo, 0 to 255."""


@dataclass(frozen=True)
class PhotoView:
    """A photo in the middle of a canvas, as large as possible."""

    photo: tuple[int, int]
    """Width and height of the upright photo, pixels."""
    canvas: tuple[int, int]
    """Width and height of the canvas, pixels."""

    @property
    def scale(self) -> float:
        """Canvas pixels for each photo pixel."""
        return min(self.canvas[0] / self.photo[0], self.canvas[1] / self.photo[1])

    @property
    def corner(self) -> tuple[float, float]:
        """Upper left corner of the photo on the canvas, pixels."""
        x, y = (0.5 * (side - self.scale * of) for side, of in zip(self.canvas, self.photo, strict=True))
        return x, y

    def pixel_at(self, place: tuple[float, float]) -> tuple[float, float] | None:
        """Return the photo's pixel at a position over the canvas's sides; None beside the photo."""
        (left, top), (width, height) = self.corner, self.photo
        x, y = (place[0] * self.canvas[0] - left) / self.scale, (place[1] * self.canvas[1] - top) / self.scale
        return (x, y) if 0 <= x < width and 0 <= y < height else None

    @property
    def drawn_size(self) -> tuple[int, int]:
        """Width and height of the photo on the canvas, pixels."""
        left, top = (round(x) for x in self.corner)
        width, height = (max(1, round(self.scale * side)) for side in self.photo)
        return min(width, self.canvas[0] - left), min(height, self.canvas[1] - top)

    def drawn(self, pixels: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "y x 3"]:
        """Draw the canvas with the photo, which may have any size."""
        left, top = (round(x) for x in self.corner)
        width, height = self.drawn_size
        out = np.full((self.canvas[1], self.canvas[0], 3), _BACKGROUND, np.uint8)
        out[top : top + height, left : left + width] = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
        return out

    def place_of(self, x: float, y: float) -> tuple[float, float]:
        """Convert a point over the photo's sides to a position over the canvas's sides."""
        (left, top), (width, height) = self.corner, self.photo
        return (left + self.scale * x * width) / self.canvas[0], (top + self.scale * y * height) / self.canvas[1]


def prompt_of(prompts: Mapping[str, ViewPrompt] | None, name: str) -> ViewPrompt:
    """Return the prompt of one photo; empty if it has none."""
    return (prompts or {}).get(_key(prompts or {}, name), ViewPrompt())


def with_click(
    prompts: Mapping[str, ViewPrompt] | None,
    name: str,
    pixel: tuple[float, float],
    *,
    on_object: bool,
    longer_side: int,
) -> dict[str, ViewPrompt] | None:
    """Add a point to the prompts, or remove the point that was clicked; None if no prompt is left.

    `pixel` is x and y in the upright photo of that name, whose `longer_side` is in pixels.
    """
    found, key = dict(prompts or {}), _key(prompts or {}, name)
    prompt, point = found.get(key, ViewPrompt()), torch.tensor([pixel]).round(decimals=1)
    near = {kind: (getattr(prompt, kind) - point).norm(dim=1) < _NEAR * longer_side for kind in ("inside", "outside")}
    if any(bool(flags.any()) for flags in near.values()):
        prompt = replace(prompt, **{kind: getattr(prompt, kind)[~flags] for kind, flags in near.items()})
    else:
        kind = "inside" if on_object else "outside"
        prompt = replace(prompt, **{kind: torch.cat([getattr(prompt, kind), point])})
    found[key] = prompt
    if not len(prompt.inside) and not len(prompt.outside) and prompt.box is None:
        del found[key]
    return found or None


def seen_best(
    point: Float[Tensor, "3"], direction: Float[Tensor, "3"], cameras: Cameras
) -> tuple[int, tuple[float, float]]:
    """Find the camera that sees a point most nearly along a direction, and the point's pixel.

    Occlusion is ignored. Raise ValueError if no camera has the point in its picture.
    """
    local = torch.einsum("vij,vj->vi", cameras.camera_from_world[:, :3, :3], point - cameras.centers)
    pixels = torch.einsum("vij,vj->vi", cameras.intrinsics, local)
    pixels = pixels[:, :2] / local[:, 2:].clamp_min(1e-9)
    inside = ((pixels >= 0) & (pixels < cameras.sizes)).all(1) & (local[:, 2] > 0)
    if not bool(inside.any()):
        raise ValueError("click: expected a place that a photo shows, found none")
    seen = torch.nn.functional.normalize(point - cameras.centers, dim=1)
    alike = torch.where(inside, seen @ torch.nn.functional.normalize(direction, dim=0), -2.0)
    index = int(alike.argmax())
    x, y = pixels[index].tolist()
    return index, (x, y)


def _key(prompts: Mapping[str, ViewPrompt], name: str) -> str:
    """Return a photo's key in the prompts: its name, with or without folder and suffix."""
    path = PurePath(name)
    return next((key for key in (name, path.name, path.stem) if key in prompts), name)
