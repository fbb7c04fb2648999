"""Evidence for the light from highlights.

Almost every surface is slightly glossy: it is brighter where it mirrors the light into the camera. The change of each
Gaussian's colour from view to view is compared with the lobes of the light from all directions. Works without
shadows, on a bare table top.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.relighting.light.surroundings import DIRECTIONS
from splatgraft.relighting.shading.normals import Normals
from splatgraft.relighting.shadows.camera_visibility import seen_from, spread_over

_CHUNK = 250
"""Gaussians at a time; bounds memory."""
_MOST_EXPLAINED = 0.98
"""Most share of the change that a light is said to explain."""


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

    def evidence(self) -> "HighlightEvidence":
        """How much of all change from view to view any distribution of light over the `DIRECTIONS` explains."""
        k = len(DIRECTIONS)
        squares, products = torch.zeros(k, k), torch.zeros(k)
        for rows in torch.arange(len(self.weight)).split(_CHUNK):
            weight = self.weight[rows][..., None]
            lobe = (self.mirrored[rows] @ DIRECTIONS.T).clamp_min(0)
            for _ in range(self.settings.squarings):
                lobe = lobe * lobe
            lobe = (lobe - _mean(lobe, weight)).reshape(-1, k)
            weighted = weight.reshape(-1, 1) * lobe
            squares += lobe.T @ weighted
            products += (weighted * self.change[rows].reshape(-1, 1)).sum(0)
        return HighlightEvidence(squares, products, float((self.weight * self.change**2).sum().clamp_min(1e-12)))


@dataclass(frozen=True)
class HighlightEvidence:
    """Highlights as a quadratic form of the luminance l from the k `DIRECTIONS`."""

    squares: Float[Tensor, "k k"]
    """Covariances of the directions' lobes over all Gaussians and cameras."""
    products: Float[Tensor, "k"]
    """Covariances of the lobes with the observed change of brightness."""
    variance: float
    """Of that change."""

    def explained(self, light: Float[Tensor, "k"]) -> float:
        """Share of the change from view to view that such a light explains, in [0, 1]."""
        light = light.to(self.products)
        return float(self._share(light @ self.products, light @ self.squares @ light))

    def explained_with_more(
        self, light: Float[Tensor, "k"], index: Int[Tensor, "c"], more: Float[Tensor, "c"]
    ) -> Float[Tensor, "c"]:
        """The same for c lights, each with `more` from the direction `index` alone."""
        light, more = light.to(self.products), more.to(self.products)
        reflected = self.squares @ light
        squares = light @ reflected + 2 * more * reflected[index] + more**2 * self.squares.diag()[index]
        return self._share(light @ self.products + more * self.products[index], squares)

    def _share(self, product: Tensor, square: Tensor) -> Tensor:
        share = product.clamp_min(0) ** 2 / (square * self.variance).clamp_min(1e-12)
        return share.clamp(0, _MOST_EXPLAINED)


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
