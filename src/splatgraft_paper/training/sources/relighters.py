"""Relighting of whole images for training: the interface of relighters, and a simple one without a learned model.

The relighter's name is written into the record of every sample.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import linear_from_srgb, resize, srgb_from_linear


@dataclass(frozen=True)
class RelightingInput:
    """An image to relight."""

    name: str
    image: Float[Tensor, "h w 3"]
    mask: Float[Tensor, "h w"]
    """Of the object."""


@runtime_checkable
class Relighter(Protocol):
    """Relights images by environment maps."""

    name: str
    """For the sample's record."""
    licence: str

    def relight(self, draft: RelightingInput, lights: Sequence[Path]) -> list[Float[Tensor, "h w 3"]]:
        """Relight the image by each environment map.

        Raises:
            ValueError: the relighter fails.
        """
        ...


class SilhouetteRelighter:
    """Shades the object's inflated silhouette by an environment map's diffuse light, without a learned model.

    It changes direction, colour and contrast of the light on the object. There are no reflections and no shape but that
    of the outline.
    """

    name = "stand-in of splatgraft (inflated silhouette, diffuse; not DiffusionRenderer)"
    licence = "own"

    def relight(self, draft: RelightingInput, lights: Sequence[Path]) -> list[Float[Tensor, "h w 3"]]:
        """Relight the object; the other pixels stay."""
        normal = inflated_normals(draft.mask)
        pictures = []
        for path in lights:
            shading = _irradiance(read_environment(path), normal)
            inside = draft.mask[..., None]
            level = (shading * inside).sum((0, 1)) / inside.sum().clamp_min(1e-6)
            # the mean over the object and its channels is kept, so that only direction and tint change
            ratio = shading / level.mean().clamp_min(1e-6)
            linear = linear_from_srgb(draft.image) * (1 + inside * (ratio - 1))
            pictures.append(srgb_from_linear(linear).clamp(0, 1))
        return pictures


def inflated_normals(mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    """Unit normals (right, up, towards the camera) of the inflated silhouette."""
    inside = (mask > 0.5).numpy().astype(np.uint8)
    depth = cv2.distanceTransform(inside, cv2.DIST_L2, 5)
    reach = max(float(depth.max()), 1.0)
    # circular profile: height^2 = reach^2 - (reach - depth)^2
    height = np.sqrt(np.maximum(reach**2 - (reach - depth) ** 2, 0)).astype(np.float32)
    height = cv2.GaussianBlur(height, (0, 0), max(reach / 10, 0.8))
    down, right = np.gradient(height)
    return F.normalize(torch.from_numpy(np.stack([-right, down, np.ones_like(height)], -1)).float(), dim=-1)


def read_environment(path: Path) -> Float[Tensor, "h w 3"]:
    """Read the linear light of an equirectangular .hdr map.

    Raises:
        ValueError: it cannot be read.
    """
    found = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR) if path.is_file() else None
    if found is None:
        raise ValueError(f"{path}: expected an environment map (.hdr), found none that can be read")
    return torch.from_numpy(np.ascontiguousarray(found[..., ::-1])).float().nan_to_num().clamp_min(0)


def _irradiance(environment: Float[Tensor, "h w 3"], normal: Float[Tensor, "h2 w2 3"]) -> Float[Tensor, "h2 w2 3"]:
    """Irradiance at each normal, up to a factor; the map is reduced to 16 x 8 directions."""
    small = resize(environment, 16, 8)
    polar = (torch.arange(8) + 0.5) / 8 * torch.pi
    azimuth = (torch.arange(16) + 0.5) / 16 * 2 * torch.pi
    theta, phi = torch.meshgrid(polar, azimuth, indexing="ij")
    direction = torch.stack([theta.sin() * phi.sin(), theta.cos(), theta.sin() * phi.cos()], -1).reshape(-1, 3)
    power = (small * theta.sin()[..., None]).reshape(-1, 3)
    return (normal @ direction.T).clamp_min(0) @ power
