"""Evidence for the direction of a scene's dominant light from highlights.

Almost every surface is slightly glossy: it is brighter where it mirrors the light into the camera. The change of each
Gaussian's colour from view to view is correlated with the lobe of a light in each candidate direction. Works without
shadows, on a bare table top.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.relighting.shading.normals import Normals
from splatgraft.relighting.shadows.camera_visibility import seen_from, spread_over

_CHUNK = 16
"""Directions at a time; bounds memory."""


@dataclass(frozen=True)
class HighlightSettings:
    """Which Gaussians and views count, and the lobe."""

    cameras: int = 20
    """Most cameras, spread over the list; set by hand."""
    gaussians: int = 2000
    """Most Gaussians, chosen at random with a fixed seed; set by hand."""
    fewest: int = 200
    """Gaussians, and pairs of Gaussian and camera; with fewer there is no evidence; set by hand."""
    fewest_cameras: int = 3
    """Cameras; with fewer there is no evidence."""
    faintest: float = 0.3
    """Opacity below which a Gaussian is left out; set by hand."""
    least_confidence: float = 0.3
    """Of its normal; below it a Gaussian is left out; set by hand."""
    lowest_cosine: float = 0.1
    """Between normal and camera; flatter views are left out; set by hand."""
    squarings: int = 3
    """The lobe is cos^(2^squarings), by default cos^8: 24 degrees wide at half height, as narrow as harmonics of degree
    3 can be, and wide enough for windows."""
    most_explained: float = 0.99
    """Most share of the variance that one direction is said to explain; set by hand."""


@dataclass(frozen=True)
class Highlights:
    """View-dependent colour of m Gaussians in v cameras."""

    mirrored: Float[Tensor, "m v 3"]
    """Unit; the direction that each Gaussian mirrors into each camera."""
    change: Float[Tensor, "m v"]
    """Linear gray minus the Gaussian's mean over its cameras."""
    weight: Float[Tensor, "m v"]
    """0 where the camera does not see the Gaussian; they sum to 1."""
    settings: HighlightSettings
    """Of the lobe."""

    def explained(self, directions: Float[Tensor, "d 3"]) -> Float[Tensor, "d"]:
        """Share of all variance from view to view that a single light in each unit direction explains, in [0, 1]."""
        total = (self.weight * self.change**2).sum().clamp_min(1e-12)
        shares = []
        for chunk in directions.split(_CHUNK):
            lobe = (self.mirrored @ chunk.T).clamp_min(0)
            for _ in range(self.settings.squarings):
                lobe = lobe * lobe
            lobe = lobe - _mean(lobe, self.weight[..., None])
            covariance = (self.weight[..., None] * lobe * self.change[..., None]).sum((0, 1)).clamp_min(0)
            variance = (self.weight[..., None] * lobe * lobe).sum((0, 1)).clamp_min(1e-12)
            shares.append(covariance**2 / (variance * total))
        return torch.cat(shares).clamp(0, self.settings.most_explained)


def find_highlights(
    scene: Gaussians,
    normals: Normals,
    cameras: Cameras,
    *,
    region: BoundingSphere,
    settings: HighlightSettings = HighlightSettings(),
) -> Highlights | None:
    """View-dependent colour of a scene's Gaussians in a region.

    Args:
        scene: All Gaussians.
        normals: Of all Gaussians.
        cameras: Of the scene's capture.
        region: Gaussians outside are left out.
        settings: Which Gaussians and views count.

    Returns:
        None where colours are view-independent (degree 0), or where too few Gaussians or cameras are left.
    """
    inside = (scene.means - region.center).norm(dim=1) < region.radius
    good = inside & normals.seen & (scene.opacities > settings.faintest)
    good &= normals.confidence > settings.least_confidence
    chosen = good.nonzero()[:, 0]
    if len(chosen) < settings.fewest or scene.sh_degree == 0 or len(cameras) < settings.fewest_cameras:
        return None
    generator = torch.Generator().manual_seed(0)
    chosen = chosen[torch.randperm(len(chosen), generator=generator)[: settings.gaussians]]
    part, facing = scene.select(chosen), normals.vectors[chosen]
    positions = spread_over(cameras, count=settings.cameras)
    seen = torch.stack([seen_from(part, cameras[i], among=scene) for i in positions], 1)
    towards = torch.nn.functional.normalize(cameras.centers[positions][None] - part.means[:, None], dim=-1)
    cosine = (towards * facing[:, None]).sum(-1)
    basis = spherical_harmonics.basis(-towards.reshape(-1, 3), part.sh_degree).reshape(*towards.shape[:2], -1)
    rgb = torch.einsum("mvk,mkc->mvc", basis, part.sh) + 0.5
    gray = linear_from_srgb(rgb.clamp(0, 1)).mean(-1)
    width = part.scales.sort(1).values[:, 1:].prod(1).sqrt()
    weight = seen * (cosine > settings.lowest_cosine) * (part.opacities * normals.confidence[chosen] * width)[:, None]
    if int((weight > 0).sum()) < settings.fewest:
        return None
    return Highlights(
        mirrored=2 * cosine[..., None] * facing[:, None] - towards,
        change=gray - _mean(gray, weight),
        weight=weight / weight.sum(),
        settings=settings,
    )


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (weight * values).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1e-12)
