"""Evidence for the light around a place from the surfaces there: their shading, their shadows and their highlights.

Shading: shadow maps from all directions give the transport to every surface, visibility times cosine, which is the
share of each direction's light that arrives. Surfaces are grouped by colour and position into materials.

Highlights: almost every surface is slightly glossy, so it is brighter where it mirrors the light into the camera. The
change of each Gaussian's colour from view to view is compared with the reflection lobes of light from all directions.
The gloss of a material is unknown: each takes the strength and the lobe, smooth or rough, that explain it best. This
needs no shadows, so it works on a bare table top.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.directions import frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.k_means import k_means
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.panorama import DIRECTIONS, FARTHEST, nearest_directions
from splatgraft.relighting.normals import is_seen
from splatgraft.relighting.shadows.shadow_maps import Occluders, Window, occluders_of, splat_depth_maps, visibility

_SEED = 0  # seed of all random choices of Gaussians
_MIN_OPACITY = 0.3  # opacity below which a Gaussian is neither a receiver nor a highlight

# receivers, the surfaces whose brightness is explained; no result is sensitive to these numbers
_MAX_RECEIVERS = 1000  # gaussians, chosen at random
_MIN_RECEIVERS = 200  # gaussians; fewer are no evidence
_MIN_NORMAL_CONFIDENCE = 0.1  # confidence of its normal below which a Gaussian is no receiver
_HALF_WEIGHT = 0.02  # linear brightness of half the weight: almost black receivers show little light
_MAX_OCCLUDERS = 16000  # gaussians that block light, chosen at random and grown to cover the same area
_OCCLUDER_OPACITY = 0.1  # opacity below which a Gaussian blocks no light
_OCCLUDERS_WITHIN = 1.3  # radii of the region within which Gaussians block light
_MAP_SIZE = 128  # pixels, a multiple of 16; width of a shadow map
_BIAS = 1.5  # pixels of a map; a nearer occluder is the receiver's own surface
_MATERIALS = 24  # groups of receivers by colour and position
_POSITION_UNIT = 0.4  # radii of the region; unit of position among the features
_GREEN_MAGENTA = 0.25
"""Unit of log(green / sqrt(red blue)) among the features; that of log(red / blue) is 1, because sun and sky differ
along it (Finlayson 2006)."""
_RECEIVER_CHUNK = 100  # receivers at a time; bounds memory

# groups by colour and normal; set by hand
_MAX_GROUPS = 20  # at least 2
_MIN_MEMBERS = 60  # mean number of sampled Gaussians in a group; smaller samples get fewer groups
_MAX_SAMPLE = 6000  # gaussians to which the means are fitted, chosen at random
_NORMAL_UNIT = 0.6  # unit of normals among the features

# highlights; set by hand
_MAX_HIGHLIGHTS = 2000  # gaussians, chosen at random
_MIN_HIGHLIGHTS = 200  # gaussians, and pairs of Gaussian and camera; fewer are no evidence
_MIN_CAMERAS = 3  # fewer are no evidence
_HIGHLIGHT_CONFIDENCE = 0.3  # confidence of its normal below which a Gaussian is left out
_LOWEST_COSINE = 0.1  # between normal and camera; flatter views are left out
_ROUGHNESS = 0.707  # of rough surfaces; its square is GGX's alpha, .5, of the order of stone, wood and grass
_FACING = 0.04  # reflectance of dielectrics at normal incidence
_MAX_EXPLAINED = 0.98  # bound of the share of the change that a light explains; its likelihood stays finite
_HIGHLIGHT_CHUNK = 250  # gaussians at a time; bounds memory


def group_materials(brightness: Float[Tensor, "m 3"], normals: Float[Tensor, "m 3"]) -> Int[Tensor, "m"]:
    """Group Gaussians that likely share one material and one side of it, by k-means, and return their group indices.

    Features are chromaticity and normal, but not brightness, which would separate lit from shaded parts.

    Args:
        brightness: Linear rgb of the m Gaussians.
        normals: Unit.
    """
    features = torch.cat([_chroma_features(brightness), normals / _NORMAL_UNIT], 1)
    sample = features[_chosen(len(features), _MAX_SAMPLE)]
    count = min(_MAX_GROUPS, max(2, len(sample) // _MIN_MEMBERS))
    return torch.cdist(features, k_means(sample, sample[:count], rounds=8)).argmin(1)


def _chroma_features(colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
    """Return log(red / blue) and log(green / sqrt(red blue)) of linear rgb, in their units."""
    red, green, blue = colors.clamp_min(1e-3).log().unbind(1)  # darker channels are noise
    return torch.stack([red - blue, green - 0.5 * (red + blue)], 1) / torch.tensor([1.0, _GREEN_MAGENTA])


def _chosen(count: int, most: int) -> Int[Tensor, "c"]:
    """Choose up to `most` of `count` positions at random."""
    return torch.randperm(count, generator=torch.Generator().manual_seed(_SEED))[:most]


@dataclass(frozen=True)
class ShadingEvidence:
    """m receivers around a place, with their visibility from the k `DIRECTIONS`."""

    region: BoundingSphere
    """Sphere that contains the receivers; its middle is the place."""
    points: Float[Tensor, "m 3"]
    """Centres, world units."""
    normals: Float[Tensor, "m 3"]
    """Unit normals, world frame."""
    visibility: Float[Tensor, "m k"]
    """Share of each direction's light that nothing blocks, in [0, 1]."""
    colors: Float[Tensor, "m 3"]
    """Linear rgb."""
    weights: Float[Tensor, "m"]
    """Weights by visible area, certainty and brightness; they sum to 1."""
    material: Int[Tensor, "m"]
    """Group of each receiver, from 0."""

    @property
    def distance(self) -> Float[Tensor, "m"]:
        """Distance from the middle of the region, in its radii."""
        return (self.points - self.region.center).norm(dim=1) / self.region.radius

    def transport(self, distances: Float[Tensor, "k"] | None = None) -> Float[Tensor, "m k"]:
        """Compute visibility times cosine, scaled so that the row of an open surface sums to 1.

        transport @ radiance is the radiance of white receivers.

        Args:
            distances: Distance of the emitter in each of the `DIRECTIONS` from the middle of the region, world units.
                Receivers off the middle see a near emitter in another direction and at another size. None: infinite.
        """
        if distances is None:
            return _transported(self.visibility, (self.normals @ DIRECTIONS.T).clamp_min(0))
        lights = self.region.center + DIRECTIONS * distances.clamp(self.region.radius, FARTHEST)[:, None]
        rows = [self._near_transport(part, lights) for part in torch.arange(len(self.points)).split(_RECEIVER_CHUNK)]
        return torch.cat(rows) if rows else self.visibility

    def _near_transport(self, part: Int[Tensor, "p"], lights: Float[Tensor, "k 3"]) -> Float[Tensor, "p k"]:
        """Compute the transport to some receivers from emitters at the points `lights`, world units."""
        away = lights - self.points[part, None]
        apart = away.norm(dim=2, keepdim=True).clamp_min(1e-6)
        towards = away / apart
        cosine = (towards * self.normals[part, None]).sum(2).clamp_min(0)
        # solid angle of an emitter that faces the middle, over its solid angle from there
        facing = (towards * DIRECTIONS).sum(2).clamp_min(0)
        size = facing * ((lights - self.region.center).norm(dim=1) / apart[..., 0]) ** 2
        seen = self.visibility[part].gather(1, nearest_directions(towards.reshape(-1, 3)).reshape(cosine.shape))
        return _transported(seen, cosine * size)


def find_shading_evidence(captured: CapturedScene, *, region: BoundingSphere) -> ShadingEvidence:
    """Choose receivers around a place and compute their visibility from all `DIRECTIONS`.

    Args:
        captured: All Gaussians.
        region: Sphere in which receivers are chosen.

    Returns:
        The evidence, without receivers if there are too few.
    """
    scene, normals = captured.gaussians, captured.normals
    inside = (scene.means - region.center).norm(dim=1) < region.radius
    good = inside & normals.seen & (scene.opacities > _MIN_OPACITY)
    candidates = (good & (normals.confidence > _MIN_NORMAL_CONFIDENCE)).nonzero()[:, 0]
    chosen = candidates[_chosen(len(candidates), _MAX_RECEIVERS)]
    if len(chosen) < _MIN_RECEIVERS:
        return _nothing(region)
    points, facing = scene.means[chosen], normals.vectors[chosen]
    colors = linear_from_srgb(rgb_from_dc(scene.sh[chosen, 0]).clamp(0.01, 1))  # their logarithm must be finite
    window = Window(center=region.center, radius=region.radius, frames=frames_along(DIRECTIONS))
    nearest = torch.full((len(DIRECTIONS),), -region.radius)
    occluders = _occluders(scene, region)
    maps = splat_depth_maps(occluders, window, size=_MAP_SIZE, nearest=nearest)
    visible = visibility(maps, points, facing, bias=_BIAS * maps.texel)
    area = scene.scales[chosen].sort(1).values[:, 1:].prod(1)
    certain = scene.opacities[chosen] * normals.confidence[chosen].clamp_min(0.05)
    weights = certain * area.clamp_max(4 * float(area.median()))
    gray = colors.mean(1)
    weights = weights * gray / (gray + _HALF_WEIGHT)
    # grouping by normals as well would explain shading by albedo
    features = torch.cat([_chroma_features(colors), (points - region.center) / (_POSITION_UNIT * region.radius)], 1)
    means = k_means(features, features[_chosen(len(features), _MATERIALS)], rounds=12)
    return ShadingEvidence(
        region=region,
        points=points,
        normals=facing,
        visibility=visible,
        colors=colors,
        weights=weights / weights.sum(),
        material=torch.cdist(features, means).argmin(1),
    )


def _transported(visibility: Float[Tensor, "m k"], weight: Float[Tensor, "m k"]) -> Float[Tensor, "m k"]:
    return visibility * weight / weight.sum(1, keepdim=True).clamp_min(1e-6)


def _nothing(region: BoundingSphere) -> ShadingEvidence:
    none, index = torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64)
    return ShadingEvidence(region, none, none, torch.zeros(0, len(DIRECTIONS)), none, torch.zeros(0), index)


def _occluders(scene: Gaussians, region: BoundingSphere) -> Occluders:
    shapes = scene.with_sh_degree(0)  # colours block no light
    near = (scene.means - region.center).norm(dim=1) < _OCCLUDERS_WITHIN * region.radius
    chosen = (near & (scene.opacities > _OCCLUDER_OPACITY)).nonzero()[:, 0]
    if len(chosen) <= _MAX_OCCLUDERS:
        return occluders_of(shapes.select(chosen))
    part = shapes.select(chosen[_chosen(len(chosen), _MAX_OCCLUDERS)])
    # fewer but wider Gaussians cover the same area
    grown = part.log_scales + 0.5 * math.log(len(chosen) / _MAX_OCCLUDERS)
    return occluders_of(replace(part, log_scales=grown))


def _smooth_lobe(normals: Float[Tensor, "p 3"], towards: Float[Tensor, "p v 3"]) -> Float[Tensor, "p v k"]:
    """Compute cos^8 about the mirrored direction, the lobe of a smooth surface (Phong).

    It is 24 degrees wide at half height: as narrow as harmonics of degree 3 can be, and wide enough for windows.
    """
    mirrored = 2 * (towards * normals[:, None]).sum(-1, keepdim=True) * normals[:, None] - towards
    lobe = (mirrored @ DIRECTIONS.T).clamp_min(0)
    for _ in range(3):
        lobe = lobe * lobe
    return lobe


def _rough_lobe(normals: Float[Tensor, "p 3"], towards: Float[Tensor, "p v 3"]) -> Float[Tensor, "p v k"]:
    """Compute the lobe of a rough dielectric (GGX, Walter et al. 2007); its peak is flatter than the mirror's."""
    a2 = _ROUGHNESS**4
    light = (normals @ DIRECTIONS.T).clamp_min(0)[:, None]
    view = (towards * normals[:, None]).sum(-1, keepdim=True).clamp_min(1e-3)
    between = towards @ DIRECTIONS.T  # cosine of light and view
    half = (2 + 2 * between).clamp_min(1e-6).sqrt()
    height = (light + view) / half
    incidence = (1 + between) / half
    spread = a2 / (height**2 * (a2 - 1) + 1) ** 2
    fresnel = _FACING + (1 - _FACING) * (1 - incidence.clamp(0, 1)) ** 5
    masked = view * (light**2 * (1 - a2) + a2).sqrt() + light * (view**2 * (1 - a2) + a2).sqrt()
    return spread * fresnel * light / masked.clamp_min(1e-6) * (light > 0)


_LOBES = (_smooth_lobe, _rough_lobe)  # the two kinds of material


@dataclass(frozen=True)
class HighlightEvidence:
    """Highlights as a quadratic form of the luminance from the k `DIRECTIONS`."""

    squares: Float[Tensor, "g r k k"]
    """Covariances of the directions' lobes over the Gaussians of g materials and all cameras, for r kinds of lobe."""
    products: Float[Tensor, "g r k"]
    """Covariances of the lobes with the observed change of brightness."""
    variance: float
    """Variance of that change."""

    def explained(self, light: Float[Tensor, "k"]) -> float:
        """Compute the share of the change from view to view that the luminance `light` explains, in [0, 1]."""
        light = light.to(self.products)
        return float(self._share(self.products @ light, self.squares @ light @ light))

    def explained_with_more(
        self, light: Float[Tensor, "k"], index: Int[Tensor, "c"], more: Float[Tensor, "c"]
    ) -> Float[Tensor, "c"]:
        """Compute the explained share of c lights, each `light` with `more` added in the one direction `index`."""
        light, more = light.to(self.products), more.to(self.products)
        reflected = self.squares @ light
        own = self.squares.diagonal(dim1=2, dim2=3)
        squares = (reflected @ light)[..., None] + 2 * more * reflected[..., index] + more**2 * own[..., index]
        return self._share((self.products @ light)[..., None] + more * self.products[..., index], squares)

    def _share(self, product: Float[Tensor, "g r *c"], square: Float[Tensor, "g r *c"]) -> Float[Tensor, "*c"]:
        """Compute the explained share if each material has the strength and the lobe that explain it best."""
        share = product.clamp_min(0) ** 2 / (square * self.variance).clamp_min(1e-12)
        return share.max(1).values.sum(0).clamp(0, _MAX_EXPLAINED)


def find_highlights(captured: CapturedScene, *, region: BoundingSphere) -> HighlightEvidence | None:
    """Compare the change of colours from view to view with the reflection lobes of all `DIRECTIONS`.

    Args:
        captured: All Gaussians, and the cameras.
        region: Sphere outside of which Gaussians are left out.

    Returns:
        The quadratic form; None if colours are view-independent (degree 0), or for too few Gaussians or cameras.
    """
    scene, normals = captured.gaussians, captured.normals
    inside = (scene.means - region.center).norm(dim=1) < region.radius
    good = inside & normals.seen & (scene.opacities > _MIN_OPACITY)
    good &= normals.confidence > _HIGHLIGHT_CONFIDENCE
    chosen = good.nonzero()[:, 0]
    if len(chosen) < _MIN_HIGHLIGHTS or scene.sh_degree == 0 or len(captured.cameras) < _MIN_CAMERAS:
        return None
    chosen = chosen[_chosen(len(chosen), _MAX_HIGHLIGHTS)]
    part, facing = scene.select(chosen), normals.vectors[chosen]
    seen = torch.stack([is_seen(part, camera, drawn) for camera, drawn in captured.views], 1)
    centers = torch.cat([camera.centers for camera, _ in captured.views])
    towards = torch.nn.functional.normalize(centers[None] - part.means[:, None], dim=-1)
    cosine = (towards * facing[:, None]).sum(-1)
    basis = spherical_harmonics.basis(-towards.reshape(-1, 3), part.sh_degree).reshape(*towards.shape[:2], -1)
    rgb = torch.einsum("mvk,mkc->mvc", basis, part.sh) + 0.5
    gray = linear_from_srgb(rgb.clamp(0, 1)).mean(-1)
    width = part.scales.sort(1).values[:, 1:].prod(1).sqrt()
    weight = seen * (cosine > _LOWEST_COSINE) * (part.opacities * normals.confidence[chosen] * width)[:, None]
    if int((weight > 0).sum()) < _MIN_HIGHLIGHTS:
        return None
    change = gray - _mean(gray, weight)
    weight = weight / weight.sum()
    material = group_materials(linear_from_srgb(rgb_from_dc(part.sh[:, 0]).clamp(0, 1)), facing)
    k, groups = len(DIRECTIONS), int(material.max()) + 1
    squares, products = torch.zeros(groups, len(_LOBES), k, k), torch.zeros(groups, len(_LOBES), k)
    for group in range(groups):
        for rows in (material == group).nonzero()[:, 0].split(_HIGHLIGHT_CHUNK):
            for i, lobe_of in enumerate(_LOBES):
                lobe = lobe_of(facing[rows], towards[rows])
                lobe = (lobe - _mean(lobe, weight[rows][..., None])).reshape(-1, k)
                weighted = weight[rows].reshape(-1, 1) * lobe
                squares[group, i] += lobe.T @ weighted
                products[group, i] += (weighted * change[rows].reshape(-1, 1)).sum(0)
    return HighlightEvidence(squares, products, float((weight * change**2).sum().clamp_min(1e-12)))


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    """Return the weighted mean over the second dimension."""
    return (weight * values).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1e-12)
