"""Evidence for the light from highlights.

Almost every surface is slightly glossy: it is brighter where it mirrors the light into the camera. The change of each
Gaussian's colour from view to view is compared with the lobes of the light from all directions. How glossy a material
is, and whether smooth or rough, is not known: each has the strength and the kind of lobe that explain it best. Works
without shadows, on a bare table top.
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
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting.light.material_groups import group_materials
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
    roughness: float = 0.707
    """Of rough surfaces; its square is GGX's alpha, .5: of the order of stone, wood and grass."""
    facing: float = 0.04
    """Reflectance of dielectrics that face the camera."""


@dataclass(frozen=True)
class Highlights:
    """View-dependent colour of m Gaussians in v cameras."""

    normals: Float[Tensor, "m 3"]
    """Unit."""
    towards: Float[Tensor, "m v 3"]
    """Unit, to each camera."""
    change: Float[Tensor, "m v"]
    """Linear gray minus the Gaussian's mean over its cameras."""
    weight: Float[Tensor, "m v"]
    """0 where the camera does not see the Gaussian; they sum to 1."""
    material: Int[Tensor, "m"]
    """Group of each Gaussian, from 0: how much and how roughly it reflects is that of its group."""
    settings: HighlightSettings
    """Of the lobes."""

    def evidence(self) -> "HighlightEvidence":
        """How much of all change from view to view any distribution of light over the `DIRECTIONS` explains."""
        k, groups = len(DIRECTIONS), int(self.material.max()) + 1
        squares, products = torch.zeros(groups, len(_LOBES), k, k), torch.zeros(groups, len(_LOBES), k)
        for group in range(groups):
            for rows in (self.material == group).nonzero()[:, 0].split(_CHUNK):
                weight = self.weight[rows][..., None]
                for i, lobe_of in enumerate(_LOBES):
                    lobe = lobe_of(self.normals[rows], self.towards[rows], self.settings)
                    lobe = (lobe - _mean(lobe, weight)).reshape(-1, k)
                    weighted = weight.reshape(-1, 1) * lobe
                    squares[group, i] += lobe.T @ weighted
                    products[group, i] += (weighted * self.change[rows].reshape(-1, 1)).sum(0)
        return HighlightEvidence(squares, products, float((self.weight * self.change**2).sum().clamp_min(1e-12)))


def _polished(
    normals: Float[Tensor, "p 3"], towards: Float[Tensor, "p v 3"], settings: HighlightSettings
) -> Float[Tensor, "p v k"]:
    """A lobe about the mirrored direction: of smooth surfaces, seen steeply."""
    mirrored = 2 * (towards * normals[:, None]).sum(-1, keepdim=True) * normals[:, None] - towards
    lobe = (mirrored @ DIRECTIONS.T).clamp_min(0)
    for _ in range(settings.squarings):
        lobe = lobe * lobe
    return lobe


def _rough(
    normals: Float[Tensor, "p 3"], towards: Float[Tensor, "p v 3"], settings: HighlightSettings
) -> Float[Tensor, "p v k"]:
    """The reflection of a rough dielectric (GGX, Walter et al. 2007), brightest at flatter views than the mirrored."""
    a2 = settings.roughness**4
    light = (normals @ DIRECTIONS.T).clamp_min(0)[:, None]
    view = (towards * normals[:, None]).sum(-1, keepdim=True).clamp_min(1e-3)
    between = towards @ DIRECTIONS.T  # cosine of light and view
    half = (2 + 2 * between).clamp_min(1e-6).sqrt()
    height = (light + view) / half
    incidence = (1 + between) / half
    spread = a2 / (height**2 * (a2 - 1) + 1) ** 2
    fresnel = settings.facing + (1 - settings.facing) * (1 - incidence.clamp(0, 1)) ** 5
    masked = view * (light**2 * (1 - a2) + a2).sqrt() + light * (view**2 * (1 - a2) + a2).sqrt()
    return spread * fresnel * light / masked.clamp_min(1e-6) * (light > 0)


_LOBES = (_polished, _rough)
"""What a material may be."""


@dataclass(frozen=True)
class HighlightEvidence:
    """Highlights as a quadratic form of the luminance l from the k `DIRECTIONS`."""

    squares: Float[Tensor, "g r k k"]
    """Covariances of the directions' lobes over the Gaussians of g materials and all cameras, for r kinds of lobe."""
    products: Float[Tensor, "g r k"]
    """Covariances of the lobes with the observed change of brightness."""
    variance: float
    """Of that change."""

    def explained(self, light: Float[Tensor, "k"]) -> float:
        """Share of the change from view to view that such a light explains, in [0, 1]."""
        light = light.to(self.products)
        return float(self._share(self.products @ light, self.squares @ light @ light))

    def explained_with_more(
        self, light: Float[Tensor, "k"], index: Int[Tensor, "c"], more: Float[Tensor, "c"]
    ) -> Float[Tensor, "c"]:
        """The same for c lights, each with `more` from the direction `index` alone."""
        light, more = light.to(self.products), more.to(self.products)
        reflected = self.squares @ light
        own = self.squares.diagonal(dim1=2, dim2=3)
        squares = (reflected @ light)[..., None] + 2 * more * reflected[..., index] + more**2 * own[..., index]
        return self._share((self.products @ light)[..., None] + more * self.products[..., index], squares)

    def _share(self, product: Float[Tensor, "g r *c"], square: Float[Tensor, "g r *c"]) -> Float[Tensor, "*c"]:
        """Each material has the strength and the kind of lobe that explain most of its own change."""
        share = product.clamp_min(0) ** 2 / (square * self.variance).clamp_min(1e-12)
        return share.max(1).values.sum(0).clamp(0, _MOST_EXPLAINED)


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
        normals=facing,
        towards=towards,
        change=gray - _mean(gray, weight),
        weight=weight / weight.sum(),
        material=group_materials(linear_from_srgb(rgb_from_dc(part.sh[:, 0]).clamp(0, 1)), facing),
        settings=settings,
    )


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (weight * values).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1e-12)
