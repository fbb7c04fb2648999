"""Evidence for the light around a place, from the surfaces there: their shading and shadows, and their highlights.

Shading: the scene is shadow-mapped from every direction: visibility times cosine, the transport, says how much of the
light from each direction arrives at each surface. Surfaces are grouped by colour and position, one material per group.

Highlights: almost every surface is slightly glossy: it is brighter where it mirrors the light into the camera. The
change of each Gaussian's colour from view to view is compared with the lobes of the light from all directions. How
glossy a material is, and whether smooth or rough, is not known: each has the strength and the kind of lobe that explain
it best. Works without shadows, on a bare table top.
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
_DARKEST_CHROMA = 1e-3  # linear light; channels darker than this count as this in chromaticities

# surfaces whose brightness is explained; none of these numbers is sensitive
_MAX_RECEIVERS = 1000
_MIN_RECEIVERS = 200  # with fewer there is no evidence
_RECEIVER_OPACITY = 0.3  # opacity below which a Gaussian is no receiver
_MIN_NORMAL_CONFIDENCE = 0.1  # confidence of its normal below which a Gaussian is no receiver
_DARKEST = 0.01  # sRGB; darker channels count as this
_HALF_WEIGHT = 0.02
"""Linear brightness at which a receiver has half its weight: almost black ones say little about light."""
_ENCLOSED = 0.15
"""Share of the directions above a surface that are open; with less it is inside something, and is left out."""
_MAX_OCCLUDERS = 16000  # gaussians that block light, chosen at random and grown to cover the same area
_OCCLUDER_OPACITY = 0.1  # opacity below which a Gaussian blocks no light
_OCCLUDERS_WITHIN = 1.3  # radii of the region within which Gaussians block light
_MAP_SIZE = 128  # pixels, a multiple of 16: width of a shadow map
_BIAS = 1.5  # pixels of a map; a nearer occluder is the receiver's own surface
_MATERIALS = 24  # groups of surfaces
_MATERIAL_ROUNDS = 12  # iterations of k-means
_POSITION_UNIT = 0.4  # radii of the region; the unit of position among the features
_GREEN_MAGENTA = 0.25
"""Unit of log(green / sqrt(red blue)) among all features, where that of log(red / blue) is 1: that one is large, as sun
and sky differ along it (Finlayson 2006)."""
_RECEIVER_CHUNK = 100  # receivers at a time; bounds memory

# groups by colour and normal; set by hand
_MAX_GROUPS = 20
_MIN_MEMBERS = 60  # gaussians of the sample per group; fewer make fewer groups, but two
_MAX_SAMPLE = 6000  # gaussians on which the means are fitted, chosen at random
_GROUP_ROUNDS = 8  # iterations of k-means
_NORMAL_UNIT = 0.6  # unit of normals among the features

# highlights; set by hand
_MAX_HIGHLIGHTS = 2000  # gaussians, chosen at random
_MIN_HIGHLIGHTS = 200  # gaussians, and pairs of Gaussian and camera; with fewer there is no evidence
_MIN_CAMERAS = 3  # with fewer there is no evidence
_HIGHLIGHT_OPACITY = 0.3  # opacity below which a Gaussian is left out
_HIGHLIGHT_CONFIDENCE = 0.3  # confidence of its normal below which a Gaussian is left out
_LOWEST_COSINE = 0.1  # between normal and camera; flatter views are left out
_SQUARINGS = 3
"""The lobe is cos^(2^squarings), cos^8: 24 degrees wide at half height, as narrow as harmonics of degree 3 can be, and
wide enough for windows."""
_ROUGHNESS = 0.707  # roughness of rough surfaces; its square is GGX's alpha, .5: of the order of stone, wood and grass
_FACING = 0.04  # reflectance of dielectrics that face the camera
_MAX_EXPLAINED = 0.98  # share of the change that a light is said to explain
_HIGHLIGHT_CHUNK = 250  # gaussians at a time; bounds memory


def group_materials(brightness: Float[Tensor, "m 3"], normals: Float[Tensor, "m 3"]) -> Int[Tensor, "m"]:
    """Group index of each Gaussian that likely shares one material and one side, by k-means.

    Features are chromaticity and normal, but not brightness, which parts lit from shaded.

    Args:
        brightness: Linear rgb of the m Gaussians.
        normals: Unit.
    """
    features = torch.cat([_chroma_features(brightness), normals / _NORMAL_UNIT], 1)
    sample = features[_chosen(len(features), _MAX_SAMPLE)]
    count = min(_MAX_GROUPS, max(2, len(sample) // _MIN_MEMBERS))
    return torch.cdist(features, k_means(sample, sample[:count], rounds=_GROUP_ROUNDS)).argmin(1)


def _chroma_features(colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
    """log(red / blue) and log(green / sqrt(red blue)) of linear rgb, in their units."""
    red, green, blue = colors.clamp_min(_DARKEST_CHROMA).log().unbind(1)
    return torch.stack([red - blue, green - 0.5 * (red + blue)], 1) / torch.tensor([1.0, _GREEN_MAGENTA])


def _chosen(count: int, most: int) -> Int[Tensor, "c"]:
    """At most `most` of `count` positions, at random."""
    return torch.randperm(count, generator=torch.Generator().manual_seed(_SEED))[:most]


@dataclass(frozen=True)
class ShadingEvidence:
    """m receivers around a place, and what blocks the light from the k `DIRECTIONS` to them."""

    region: BoundingSphere
    """They lie within it; its middle is the place."""
    points: Float[Tensor, "m 3"]
    """Centres, world units."""
    normals: Float[Tensor, "m 3"]
    """Unit."""
    visibility: Float[Tensor, "m k"]
    """In [0, 1]."""
    colors: Float[Tensor, "m 3"]
    """Linear rgb."""
    weights: Float[Tensor, "m"]
    """By visible area and certainty; they sum to 1."""
    material: Int[Tensor, "m"]
    """Group of each receiver, from 0."""

    @property
    def distance(self) -> Float[Tensor, "m"]:
        """From the middle of the region, in its radii."""
        return (self.points - self.region.center).norm(dim=1) / self.region.radius

    def transport(self, distances: Float[Tensor, "k"] | None = None) -> Float[Tensor, "m k"]:
        """Visibility times cosine, scaled so that an open surface's row sums to 1.

        transport @ radiance is the radiance of a white surface.

        Args:
            distances: World units, from the middle of the region to what shines from each of the `DIRECTIONS`: other
                places see it in other directions, and larger where it is nearer. Infinitely far where not given.
        """
        if distances is None:
            return _transported(self.visibility, (self.normals @ DIRECTIONS.T).clamp_min(0))
        lights = self.region.center + DIRECTIONS * distances.clamp(self.region.radius, FARTHEST)[:, None]
        rows = [self._near_transport(part, lights) for part in torch.arange(len(self.points)).split(_RECEIVER_CHUNK)]
        return torch.cat(rows) if rows else self.visibility

    def _near_transport(self, part: Int[Tensor, "p"], lights: Float[Tensor, "k 3"]) -> Float[Tensor, "p k"]:
        """Transport to some receivers from lights at places in world units."""
        away = lights - self.points[part, None]
        apart = away.norm(dim=2, keepdim=True).clamp_min(1e-6)
        towards = away / apart
        cosine = (towards * self.normals[part, None]).sum(2).clamp_min(0)
        # solid angle of what shines, over that from the middle; it faces the middle
        facing = (towards * DIRECTIONS).sum(2).clamp_min(0)
        size = facing * ((lights - self.region.center).norm(dim=1) / apart[..., 0]) ** 2
        seen = self.visibility[part].gather(1, nearest_directions(towards.reshape(-1, 3)).reshape(cosine.shape))
        return _transported(seen, cosine * size)


def find_shading_evidence(captured: CapturedScene, *, region: BoundingSphere) -> ShadingEvidence:
    """Receivers around a place and the transport of light to them; none where there are too few.

    Args:
        captured: All Gaussians.
        region: Receivers lie within it.
    """
    scene, normals = captured.gaussians, captured.normals
    inside = (scene.means - region.center).norm(dim=1) < region.radius
    good = inside & normals.seen & (scene.opacities > _RECEIVER_OPACITY)
    candidates = (good & (normals.confidence > _MIN_NORMAL_CONFIDENCE)).nonzero()[:, 0]
    chosen = candidates[_chosen(len(candidates), _MAX_RECEIVERS)]
    if len(chosen) < _MIN_RECEIVERS:
        return _nothing(region)
    points, facing = scene.means[chosen], normals.vectors[chosen]
    colors = linear_from_srgb(rgb_from_dc(scene.sh[chosen, 0]).clamp(_DARKEST, 1))
    window = Window(center=region.center, radius=region.radius, frames=frames_along(DIRECTIONS))
    nearest = torch.full((len(DIRECTIONS),), -region.radius)
    occluders = _occluders(scene, region)
    maps = splat_depth_maps(occluders, window, size=_MAP_SIZE, with_color=False, nearest=nearest)
    visible = visibility(maps, points, facing, bias=_BIAS * maps.texel)
    open_ = _transported(visible, (facing @ DIRECTIONS.T).clamp_min(0)).sum(1)
    area = scene.scales[chosen].sort(1).values[:, 1:].prod(1)
    certain = scene.opacities[chosen] * normals.confidence[chosen].clamp_min(0.05)
    weights = certain * area.clamp_max(4 * float(area.median()))
    gray = colors.mean(1)
    weights = weights * (gray / (gray + _HALF_WEIGHT)) * (open_ > _ENCLOSED)
    if float(weights.sum()) <= 0:
        return _nothing(region)
    # similar colour and position, not similar normals: those would hide the light
    features = torch.cat([_chroma_features(colors), (points - region.center) / (_POSITION_UNIT * region.radius)], 1)
    means = k_means(features, features[_chosen(len(features), _MATERIALS)], rounds=_MATERIAL_ROUNDS)
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
    near = (scene.means - region.center).norm(dim=1) < _OCCLUDERS_WITHIN * region.radius
    chosen = (near & (scene.opacities > _OCCLUDER_OPACITY)).nonzero()[:, 0]
    if len(chosen) <= _MAX_OCCLUDERS:
        return occluders_of(scene.select(chosen))
    part = scene.select(chosen[_chosen(len(chosen), _MAX_OCCLUDERS)])
    # fewer, wider: together they cover the same area
    grown = part.log_scales + 0.5 * math.log(len(chosen) / _MAX_OCCLUDERS)
    return occluders_of(replace(part, log_scales=grown))


def _polished(normals: Float[Tensor, "p 3"], towards: Float[Tensor, "p v 3"]) -> Float[Tensor, "p v k"]:
    """A lobe about the mirrored direction: of smooth surfaces, seen steeply."""
    mirrored = 2 * (towards * normals[:, None]).sum(-1, keepdim=True) * normals[:, None] - towards
    lobe = (mirrored @ DIRECTIONS.T).clamp_min(0)
    for _ in range(_SQUARINGS):
        lobe = lobe * lobe
    return lobe


def _rough(normals: Float[Tensor, "p 3"], towards: Float[Tensor, "p v 3"]) -> Float[Tensor, "p v k"]:
    """The reflection of a rough dielectric (GGX, Walter et al. 2007), brightest at flatter views than the mirrored."""
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


_LOBES = (_polished, _rough)  # what a material may be


@dataclass(frozen=True)
class HighlightEvidence:
    """Highlights as a quadratic form of the luminance l from the k `DIRECTIONS`."""

    squares: Float[Tensor, "g r k k"]
    """Covariances of the directions' lobes over the Gaussians of g materials and all cameras, for r kinds of lobe."""
    products: Float[Tensor, "g r k"]
    """Covariances of the lobes with the observed change of brightness."""
    variance: float
    """Variance of that change."""

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
        return share.max(1).values.sum(0).clamp(0, _MAX_EXPLAINED)


def find_highlights(captured: CapturedScene, *, region: BoundingSphere) -> HighlightEvidence | None:
    """How much of the change of colours from view to view any distribution of light over the `DIRECTIONS` explains.

    Args:
        captured: All Gaussians, and the cameras.
        region: Gaussians outside are left out.

    Returns:
        None where colours are view-independent (degree 0), or where too few Gaussians or cameras are left.
    """
    scene, normals = captured.gaussians, captured.normals
    inside = (scene.means - region.center).norm(dim=1) < region.radius
    good = inside & normals.seen & (scene.opacities > _HIGHLIGHT_OPACITY)
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
    """Weighted mean over the second dimension."""
    return (weight * values).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1e-12)
