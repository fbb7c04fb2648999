"""Direction and strength of the sun from the shadows that a scene shows on the level surface around a place.

`find_sun` searches for the sun:

1. Draw the surface as a picture from above, the median over the cameras.
2. Draw the shadow that the Gaussians above the surface cast for each of 1,600 sun directions, and the ambient occlusion
   at their feet.
3. Compare differences of log luminance between texels a few texels apart in the picture with the differences that sun
   and other light predict. The density of a difference is a Cauchy density, because texels also differ by material. It
   is mixed with the chance that something unseen shades a texel, or a whole tile of the picture.
4. Refine the best directions, then fit angular radius and strength at the edges of the shadows.
5. Compare the sun with lamps at a few heights, whose shadows diverge.
6. If no direction is decisively better than no sun, do the same within the cameras' median distance. Out of doors this
   wider region is larger, and the second level surface is searched, too, such as the ground around a table.

Where a sun is known to exist, `sun_near` moves it to the shadows of several surfaces.

`set_sun` searches in the same way near the direction of points that a user marks together with their shadows.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.directions import even_directions, frames_along, tangents, vogel_offsets
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import LUMINANCE, linear_from_srgb
from splatgraft.core.planes import LevelPlane, LevelPlaneOptions, dominant_level_plane
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.light import Light, LightSource
from splatgraft.relighting.shadows.shadow_maps import Occluders, Window, occluders_of, splat_depth_maps, thinned
from splatgraft.rendering import Render

# the picture of the surface; set by hand
_SIZE = 192  # texels, a multiple of 16; width of the picture and of the shadow maps
_PLANE = LevelPlaneOptions(inlier_share=0.2, thickness=0.035)
_MIN_TEXELS = 1500  # with fewer usable texels there is no evidence
_WHITE, _BLACK = 0.93, 0.01  # linear; brighter channels may be clipped, darker luminances are noise

# differences between texels; set by hand
_COARSE, _FINE, _ACROSS = 6, 3, 14  # texels between compared texels: search, refinement, ratio of lit to shaded
_NOISE = 0.12  # scale of differences of log luminance within a material
_SHADED_TEXEL, _SHADED_TILE = 0.15, 0.5  # probabilities that something unseen shades a texel, and a whole tile
_TILES = 8  # tiles along a side of the picture

# the search
_DIRECTIONS = even_directions(1600)  # 5 degrees apart
_AMBIENT_DIRECTIONS = even_directions(200)  # directions of all other light, on both sides of the surface
_DARKEST = 0.02  # lower bound of that light's visibility at a texel, because occluders reflect some of it
_STANDING_WITHIN = 1.4  # radii of the region within which Gaussians cast shadows
LOWEST_SINE = math.sin(math.radians(2.0))  # sine of the sun's minimum height over the surface
_STRENGTHS = (0.5, 1.0, 1.8, 3.0, 5.0, 10.0)  # irradiance of the sun over that of all other light on the surface
_FEW_STRENGTHS = _STRENGTHS[1::2]  # in the search
_APART = math.cos(math.radians(8.0))  # cosine of the minimum angle between two maxima
_FINE_STEPS_DEG = (1.0, 0.33)  # of the grids around a maximum, three on each side
_LAMP_HEIGHTS, _LAMP_SPAN_DEG = (4.0, 2.0), 10.0  # half widths of the surface; search around the sun's direction
_PROMISING = 10.0  # log likelihood over that of even light above which a direction of the search is refined
_DECISIVE = 40.0  # log likelihood over no sun above which there is a sun; chosen with benchmarks/fit_sun.py
SURFACES = 2  # level surfaces whose shadows show a sun: a table, and the ground around it
_STEP_DEG = 2.5  # of the grids of directions around a given one
_IMPROBABLE = 4.5  # difference of log densities to the most probable direction, as at 3 standard errors
_WIDER = 3.0  # radius of a wider region over the given one: few things stand near a small object
_TEMPERATURE = 5.0  # divisor of the shadows' log likelihood beside a prior, because texels share their errors
_MIN_RATIO = 0.3  # minimum irradiance of a sun over that of all other light
_MIN_RATIO_BY_HAND = 0.6  # the same for a sun set by hand if no edge of a shadow shows its strength
_RADII_DEG, _CONE = (0.3, 1.0, 2.0, 4.0, 8.0), 12  # angular radii that are tried, and directions that sample each
_MAX_TINT = 0.85
"""Largest absolute log of a channel's ratio over that of luminance. Nine suns measured on rendered scenes have .04 to
.87; one measured on photographs of a lawn has 1.66, because their contrast makes shade bluer."""
UNSEEN_RADIUS_DEG = 1.0  # angular radius of a source that neither a camera nor an edge of a shadow shows
_LIKELIER = 3.0  # difference of log likelihoods, 20 to 1, for a larger radius, and for the strength near a known sun
ERROR_DEG = 1.0  # standard error of a direction that was found; minimum for others
_BY_HAND_DEG = 15.0  # standard error of a direction set by hand; the search reaches twice as far
_BELOW_LAMP = 0.9  # of a lamp's height; what stands higher blocks as if it stood there
_AROUND_SHADOW = 2.5  # region in which a sun set by hand is measured, in distances from a point to its shadow

SET_BY_HAND = "sun set by hand"
"""Name in reports of a sun from `set_sun`."""

Point = tuple[float, float, float]
"""World units."""

LogPrior = Callable[[Float[Tensor, "k 3"]], Float[Tensor, "k"]]
"""Log density of k unit directions of the sun."""


def _even(directions: Float[Tensor, "k 3"]) -> Float[Tensor, "k"]:
    return torch.zeros(len(directions))


@dataclass(frozen=True)
class Sun:
    """A sun found from shadows on a surface."""

    direction: Float[Tensor, "3"]
    """Unit vector towards the sun, world frame."""
    radius_deg: float
    """Angular radius, degrees; a window's is larger than the sun's."""
    normal: Float[Tensor, "3"]
    """Unit normal of the surface, upwards."""
    ratio: Float[Tensor, "3"] | None
    """Irradiance of the sun over that of all other light on the surface, for each channel; None if not measured."""
    evidence: float
    """Log likelihood over that of all other light alone; infinite if set by hand."""
    error_deg: float = ERROR_DEG
    """Standard error of the direction, degrees."""
    name: str = ""
    """Name in reports, as in `LightSource`; empty for a sun that was found."""
    blockers_within: float = math.inf
    """Maximum distance of occluders that block the sun, world units."""
    distance: float = math.inf
    """Distance from the place, world units; finite for a lamp, whose shadows diverge."""


@dataclass(frozen=True)
class Surface:
    """A square of a level plane, divided into s x s texels."""

    plane: LevelPlane
    """Plane, with an upward normal."""
    center: Float[Tensor, "3"]
    """Middle of the square, on the plane, world units."""
    half: float
    """Half the width of the square, world units."""

    def texels(self, every: int = 1) -> Float[Tensor, "s s 3"]:
        """Return the middles of the texels in every `every`-th row and column, world units."""
        right, down = tangents(self.plane.normal)
        x = ((torch.arange(0, _SIZE, every) + 0.5) / _SIZE * 2 - 1) * self.half
        v, u = torch.meshgrid(x, x, indexing="ij")
        return self.center + u[..., None] * right + v[..., None] * down

    def shadows(self, occluders: Occluders, directions: Float[Tensor, "k 3"], every: int = 1) -> Float[Tensor, "k s s"]:
        """Compute the share of light from each of k directions that reaches texels past occluders above the plane.

        Args:
            occluders: Gaussians that block light.
            directions: Unit, towards the light.
            every: Stride of the texels.
        """
        radius = 1.05 * self.half
        window = Window(center=self.center, radius=radius, frames=frames_along(directions))
        alpha = splat_depth_maps(occluders, window, size=_SIZE).alpha
        at = torch.einsum("kij,stj->ksti", window.frames[:, :2], self.texels(every) - self.center) / radius
        return 1 - F.grid_sample(alpha[:, None], at, align_corners=False)[:, 0]

    def ambient(self, occluders: Occluders) -> Float[Tensor, "s s"]:
        """Compute the share of an even sky's irradiance that reaches the texels past occluders above the plane."""
        cosines = _AMBIENT_DIRECTIONS @ self.plane.normal
        above = cosines > LOWEST_SINE
        visible = self.shadows(occluders, _AMBIENT_DIRECTIONS[above])
        return torch.einsum("k,kst->st", cosines[above] / cosines[above].sum(), visible).clamp_min(_DARKEST)


@dataclass(frozen=True)
class SurfacePicture:
    """A surface as the views of a capture show it."""

    surface: Surface
    """Surface of s x s texels."""
    log_rgb: Float[Tensor, "s s 3"]
    """Logarithm of linear rgb, median over the views."""
    valid: Bool[Tensor, "s s"]
    """Whether enough views show the texel, neither clipped nor black."""


def find_surfaces(captured: CapturedScene, region: BoundingSphere, *, most: int = 1) -> list[Surface]:
    """Find up to `most` level surfaces that the cameras see in a region, the largest first."""
    seen = []
    for camera, drawn in captured.views:
        points = camera.unproject(drawn.depth[0])
        is_solid = drawn.alpha[0] > 0.9
        seen.append(points[is_solid & ((points - region.center).norm(dim=-1) < region.radius)])
    points = torch.cat(seen)
    points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:6000]]
    surfaces = list[Surface]()
    while len(surfaces) < most:
        plane = dominant_level_plane(points, captured.up, options=_PLANE)
        if plane is None:
            break
        away = plane.height(points).abs()
        on_it = points[away < plane.thickness]
        center = on_it.median(0).values
        center = center - plane.height(center) * plane.normal
        surfaces.append(Surface(plane, center, float((on_it - center).norm(dim=1).quantile(0.95))))
        points = points[away > 2 * plane.thickness]
    return surfaces


def draw_surface(captured: CapturedScene, surface: Surface) -> SurfacePicture:
    """Draw a surface as the median of the views of a capture."""
    colors = torch.stack([_seen_texels(surface, camera, drawn) for camera, drawn in captured.views])
    enough = (~colors[..., 0].isnan()).sum(0) >= 2  # views
    log_rgb = colors.nanmedian(0).values.nan_to_num()
    linear = log_rgb.exp()
    return SurfacePicture(surface, log_rgb, enough & (linear.amax(-1) < _WHITE) & (linear @ LUMINANCE > _BLACK))


def standing_on(surface: Surface, scene: Gaussians, region: BoundingSphere) -> Occluders:
    """Select the Gaussians above a surface, in a region or a little outside, as occluders."""
    near = (scene.means - region.center).norm(dim=1) < _STANDING_WITHIN * region.radius
    above = scene.select(near & (surface.plane.height(scene.means) > surface.plane.thickness))
    return occluders_of(thinned(above, width=2 * surface.half / _SIZE))


def _seen_texels(surface: Surface, camera: Cameras, drawn: Render) -> Float[Tensor, "s s 3"]:
    """Return the logarithm of linear rgb of the texels in one view; nan if it does not show the surface there."""
    texels = surface.texels()
    pixels, depth = camera.project(texels)
    away, at = depth.clamp_min(1e-6), pixels / camera.sizes[0].to(texels) * 2 - 1
    color = linear_from_srgb(drawn.color[0].clamp(0, 1))
    picture = torch.cat([color, drawn.depth[0][..., None]], -1).permute(2, 0, 1)
    sampled = F.grid_sample(picture[None], at[None], align_corners=False)[0]
    rays = texels - camera.centers[0]
    distance = rays.norm(dim=-1)
    steepness = -(rays @ surface.plane.normal) / distance
    # height over the plane of the point that the view shows along the ray to a texel
    height = (1 - sampled[3] / away) * distance * steepness
    shown = (depth > 0) & (at.abs().amax(-1) < 1) & (height.abs() < surface.plane.thickness)
    shown &= steepness > 0.12  # flatter views are too inaccurate
    return torch.where(shown[..., None], sampled[:3].permute(1, 2, 0).clamp_min(1e-3).log(), math.nan)


@dataclass(frozen=True)
class _Differences:
    """p pairs of texels along one axis of a picture."""

    first: Int[Tensor, "p"]
    second: Int[Tensor, "p"]
    """Positions of the two texels, row by row."""
    luminance: Float[Tensor, "p"]
    """Log luminance of the second texel minus that of the first, in units of `_NOISE`."""
    tile: Int[Tensor, "p"]
    """Tile of each pair."""

    def of(self, values: Float[Tensor, "k s s"]) -> Float[Tensor, "k p"]:
        """Compute the differences of other values between the same texels."""
        flat = values.flatten(1)
        return flat.index_select(1, self.second) - flat.index_select(1, self.first)

    def log_likelihoods(self, brightness: Float[Tensor, "k s s"]) -> Float[Tensor, "k p"]:
        """Compute the log likelihood of each pair under k log irradiances, over that of even light."""
        # a ratio of two Cauchy densities, mixed with 1
        share = (1 - _SHADED_TEXEL) * (1 + self.luminance.square())
        off = self.of(brightness).div_(-_NOISE).add_(self.luminance)
        return (share / off.square_().add_(1)).add_(_SHADED_TEXEL).log_()


@dataclass(frozen=True)
class _Comparison:
    """Differences of a picture between texels at a fixed distance along both axes."""

    apart: int
    """Distance between the two texels of a pair, texels."""
    step: int
    """Distance between one pair and the next, texels. Pairs depend on each other, so each counts (step / apart)^2."""
    every: int
    """Stride at which texels are compared: only every `every`-th row and column is used."""
    axes: tuple[_Differences, _Differences]
    """Horizontal and vertical differences."""

    @staticmethod
    def of(picture: SurfacePicture, apart: int, step: int | None = None) -> "_Comparison":
        """Compare texels.

        Args:
            picture: The surface.
            apart: Distance between the two texels of a pair, texels.
            step: Distance between pairs, texels; None: half of `apart`, at least 2.
        """
        step = step or max(2, apart // 2)
        every = step if apart % step == 0 else 1
        log_rgb, valid = picture.log_rgb[::every, ::every], picture.valid[::every, ::every]
        log_luminance = (log_rgb.exp() @ LUMINANCE).log()
        tile = torch.arange(0, _SIZE, every) * _TILES // _SIZE
        tile = tile[:, None] * _TILES + tile
        skip, gap = step // every, apart // every
        whole, low, high = slice(None, None, skip), slice(0, len(tile) - gap, skip), slice(gap, None, skip)
        position = torch.arange(tile.numel()).reshape(tile.shape)

        def along(first: tuple[slice, slice], second: tuple[slice, slice]) -> _Differences:
            chosen = valid[first] & valid[second]
            change = (log_luminance[second] - log_luminance[first])[chosen] / _NOISE
            return _Differences(position[first][chosen], position[second][chosen], change, tile[first][chosen])

        return _Comparison(apart, step, every, (along((whole, low), (whole, high)), along((low, whole), (high, whole))))

    def log_likelihoods(self, irradiance: Float[Tensor, "k s s"]) -> Float[Tensor, "k"]:
        """Compute the log likelihood of k patterns of irradiance on the surface over that of even light."""
        brightness, by_tile = irradiance.log(), torch.zeros(len(irradiance), _TILES**2)
        for one in self.axes:
            by_tile.index_add_(1, one.tile, one.log_likelihoods(brightness))
        shown = by_tile * (self.step / self.apart) ** 2 + math.log(1 - _SHADED_TILE)
        return torch.logaddexp(shown, torch.tensor(math.log(_SHADED_TILE))).sum(1)

    def of_suns(
        self, visible: Float[Tensor, "k s s"], ambient: Float[Tensor, "s s"], strengths: tuple[float, ...]
    ) -> Float[Tensor, "k"]:
        """Compute the log likelihood of k suns over that of even light, each at its best strength.

        Args:
            visible: Share of each sun's light that reaches the texels.
            ambient: Share of all other light that reaches them.
            strengths: Irradiance of the unblocked sun over that of all other unblocked light on the surface.
        """
        return torch.stack([self.log_likelihoods(ambient + s * visible) for s in strengths]).amax(0)


@dataclass(frozen=True)
class _ShadowEvidence:
    """Shadows that a surface shows, and the occluders that may cast them."""

    picture: SurfacePicture
    standing: Occluders
    """Gaussians above the surface."""
    ambient: Float[Tensor, "s s"]
    """Share of all other light that reaches the texels."""

    @staticmethod
    def on_surfaces(captured: CapturedScene, region: BoundingSphere, *, most: int) -> "Iterator[_ShadowEvidence]":
        """Yield the evidence of level surfaces in a region, without those with too few texels or no occluders.

        Args:
            captured: The scene.
            region: Sphere that contains the surfaces and the occluders on them.
            most: Maximum number of surfaces, the largest first.
        """
        for surface in find_surfaces(captured, region, most=most):
            standing, picture = standing_on(surface, captured.gaussians, region), draw_surface(captured, surface)
            if len(standing.means) and int(picture.valid.sum()) >= _MIN_TEXELS:
                yield _ShadowEvidence(picture, standing, surface.ambient(standing))

    @staticmethod
    def of(captured: CapturedScene, region: BoundingSphere) -> "_ShadowEvidence | None":
        """Collect the evidence of the largest level surface; None without one, with too few texels or no occluders."""
        return next(_ShadowEvidence.on_surfaces(captured, region, most=1), None)

    @property
    def surface(self) -> Surface:
        return self.picture.surface

    def of_lamp(self, direction: Float[Tensor, "3"], height: float) -> "_ShadowEvidence":
        """Move the occluders so that the shadows of parallel light become those of a lamp.

        The shadows hold for directions near `direction`, each for a lamp in that direction from the surface's centre.

        Args:
            direction: Unit, from the surface's centre towards the lamp.
            height: Height of the lamp above the surface, world units.
        """
        normal, center = self.surface.plane.normal, self.surface.center
        away = height / float(direction @ normal) * direction - height * normal  # from the centre to the lamp's foot
        h = self.surface.plane.height(self.standing.means)[:, None].clamp_max(_BELOW_LAMP * height)
        foot = self.standing.means - h * normal
        moved = self.standing.means + (foot - center - away) * h / (height - h) + away * h / height
        return replace(self, standing=replace(self.standing, means=moved))

    def above(self, directions: Float[Tensor, "k 3"]) -> Float[Tensor, "m 3"]:
        """Select the directions above the surface."""
        return directions[directions @ self.surface.plane.normal > LOWEST_SINE]

    def log_likelihoods(self, directions: Float[Tensor, "k 3"]) -> Float[Tensor, "k"]:
        """Compute the log likelihood of suns in k directions over that of even light, without the finest edges."""
        coarse = _Comparison.of(self.picture, _COARSE)
        every = coarse.every
        ambient = self.ambient[::every, ::every]
        visible = (self.surface.shadows(self.standing, part, every) for part in directions.split(64))  # bounds memory
        return torch.cat([coarse.of_suns(one, ambient, _FEW_STRENGTHS) for one in visible])

    def best(self, directions: Float[Tensor, "k 3"], log_prior: LogPrior = _even) -> tuple[Float[Tensor, "3"], float]:
        """Find the sun's most probable direction.

        Args:
            directions: Unit directions above the surface, among which the maxima are searched.
            log_prior: Log density of directions.

        Returns:
            The direction, and the log likelihood of its shadows over that of no sun, -inf if none is promising.
        """
        fine, surface = _Comparison.of(self.picture, _FINE), self.surface
        blurred_ambient = _blurred(self.ambient[None])
        without = max(0.0, float(fine.log_likelihoods(blurred_ambient)))
        score = self.log_likelihoods(directions) + _TEMPERATURE * log_prior(directions)
        best, likeliest, evidence = directions[0], -math.inf, -math.inf
        for _ in range(4):  # maxima that are refined
            if float(score.max()) < _PROMISING:
                break
            mode = directions[score.argmax()]
            score = torch.where(directions @ mode > _APART, -math.inf, score)
            for step in _FINE_STEPS_DEG:
                near = self.above(_around(mode, 3 * step, step))
                shadows = _blurred(surface.shadows(self.standing, near))
                found = fine.of_suns(shadows, blurred_ambient[0], _STRENGTHS) - without
                posterior = found + _TEMPERATURE * log_prior(near)
                i = int(posterior.argmax())
                mode = near[i]
                if float(posterior[i]) > likeliest:
                    best, likeliest, evidence = mode, float(posterior[i]), float(found[i])
        return best, evidence


def find_sun(
    captured: CapturedScene, region: BoundingSphere, *, outdoors: bool = False, decisive: float = _DECISIVE
) -> Sun | None:
    """Find the sun, or the lamp, whose shadows a level surface shows.

    The largest level surface in the region is searched, then that within the cameras' median distance.

    Args:
        captured: The scene with all objects that cast shadows during the capture.
        region: Sphere around the place that contains the surfaces and the occluders on them.
        outdoors: Whether to search two surfaces in each region, and to enlarge the wider one. In rooms this finds false
            suns.
        decisive: Minimum log likelihood over that of no sun.

    Returns:
        The sun on the first surface with one; None if no direction is decisively better than no sun.
    """
    distance = float((captured.cameras.centers - region.center).norm(dim=1).median())
    wider, most = (_WIDER * region.radius, SURFACES) if outdoors else (region.radius, 1)
    for radius in dict.fromkeys((region.radius, max(wider, distance))):
        for shown in _ShadowEvidence.on_surfaces(captured, replace(region, radius=radius), most=most):
            sun = _shown_sun(shown, region, decisive)
            if sun is not None:
                return sun
    return None


def _shown_sun(shown: _ShadowEvidence, region: BoundingSphere, decisive: float) -> Sun | None:
    """Find the sun, or the lamp as seen from the region's centre, whose shadows a surface shows; None without one."""
    direction, evidence = shown.best(shown.above(_DIRECTIONS))
    if evidence < decisive:
        return None
    sun = _measured(shown, direction, evidence)
    lamp = None if sun is None else _lamp_near(sun, shown)
    if lamp is None:
        return sun
    towards = shown.surface.center + lamp.distance * lamp.direction - region.center
    return replace(lamp, direction=F.normalize(towards, dim=0), distance=float(towards.norm()))


def _measured(shown: _ShadowEvidence, direction: Float[Tensor, "3"], evidence: float) -> Sun | None:
    """Measure radius and ratio of a sun in a direction; None if its shadows show no strength."""
    radius, ratio = _radius_and_ratio(shown, direction)
    if ratio is None or float(ratio @ LUMINANCE) < _MIN_RATIO:
        return None
    return Sun(direction, radius, shown.surface.plane.normal, ratio, evidence)


def _lamp_near(sun: Sun, shown: _ShadowEvidence) -> Sun | None:
    """Find a lamp near a sun, as seen from the surface's centre; None if no lamp is clearly likelier than the sun."""
    near = shown.above(_around(sun.direction, _LAMP_SPAN_DEG, _STEP_DEG))
    least = float(shown.log_likelihoods(near).max()) + _PROMISING
    found = list[tuple[float, float, _ShadowEvidence]]()
    for height in (share * shown.surface.half for share in _LAMP_HEIGHTS):
        of_lamp = shown.of_lamp(sun.direction, height)
        found.append((float(of_lamp.log_likelihoods(near).max()), height, of_lamp))
    likelihood, height, lamp = max(found, key=itemgetter(0))
    if likelihood < least:
        return None
    direction, evidence = lamp.best(near)
    measured = _measured(lamp, direction, evidence) if evidence > sun.evidence else None
    return None if measured is None else replace(measured, distance=height / float(direction @ measured.normal))


def sun_near(
    directions: Float[Tensor, "k 3"],
    log_density: Float[Tensor, "k"],
    captured: CapturedScene,
    region: BoundingSphere,
    *,
    name: str = "",
) -> Sun:
    """Find the direction of a sun that is known to exist, from shadows that may be too faint to prove a sun.

    The log likelihoods of the shadows on the largest level surfaces in a wider region are added to a given density.

    Args:
        directions: Unit directions in which the sun may stand.
        log_density: Log density of each without these shadows.
        captured: The scene with all objects that cast shadows during the capture.
        region: Sphere around the place.
        name: Name in reports.

    Returns:
        The sun in the mean direction, with the standard error of that. Its ratio is None if no surface clearly shows
        its shadow.
    """
    wider = replace(region, radius=_WIDER * region.radius)
    surfaces = list(_ShadowEvidence.on_surfaces(captured, wider, most=SURFACES))
    probable = log_density > -math.inf
    for one in surfaces:
        probable &= directions @ one.surface.plane.normal > LOWEST_SINE
    probable &= log_density > log_density[probable].max() - _IMPROBABLE
    near = directions[probable]
    log_density = sum((one.log_likelihoods(near) for one in surfaces), log_density[probable])
    weights = log_density.softmax(0)
    mean = F.normalize(weights @ near, dim=0)
    variance = weights @ torch.rad2deg((near @ mean).clamp(-1, 1).acos()).square() / 2  # of two axes
    error_deg = max(float(variance.sqrt()), ERROR_DEG)
    moved = Sun(mean, UNSEEN_RADIUS_DEG, captured.up, None, 0.0, error_deg, name)
    shadows = [(float(one.log_likelihoods(mean[None])), one) for one in surfaces]
    evidence, shown = max(shadows, key=itemgetter(0), default=(0.0, None))
    if shown is None or evidence < _LIKELIER:
        return moved
    measured = _measured(shown, mean, evidence)
    return moved if measured is None else replace(measured, error_deg=error_deg, name=name)


def prior_near(towards: Float[Tensor, "c 3"], error_deg: float, *, wrong: float = 0.0) -> LogPrior:
    """Return the log density over that of an even hemisphere, if one of c directions is right.

    Args:
        towards: Unit directions of the same probability.
        error_deg: Their standard error.
        wrong: Probability that none is right.
    """
    error = math.radians(error_deg)
    log_right, log_wrong = math.log((1 - wrong) / (len(towards) * error**2)), torch.tensor(wrong).log()

    def log_prior(directions: Float[Tensor, "k 3"]) -> Float[Tensor, "k"]:
        away = (directions @ towards.T).clamp(-1, 1).acos() / error
        return torch.logaddexp((-0.5 * away.square()).logsumexp(1) + log_right, log_wrong)

    return log_prior


def set_sun(points: Sequence[Point], captured: CapturedScene) -> Sun:
    """Make the sun that casts the shadows of some points at other given points.

    The mean direction of the pairs is a prior for the search around the first pair whose surroundings show a shadow's
    edge: the direction moves to the shadows there, which also show radius and strength. If no pair's do, the direction
    is the mean, its error the spread, and the strength is that of the sources that the sun replaces.

    Args:
        points: Pairs, world units: a point that casts a shadow, then the same point of its shadow.
        captured: The scene with the objects that cast the shadows.

    Raises:
        ValueError: The points are not pairs, or a shadow lies higher than the point that casts it.
    """
    direction, spread_deg = direction_through(points, captured.up)
    pairs = torch.tensor(points).reshape(-1, 2, 3)
    for caster, shadow in pairs.unbind():
        shown = _ShadowEvidence.of(captured, BoundingSphere(shadow, _AROUND_SHADOW * float((caster - shadow).norm())))
        near = torch.zeros(0, 3) if shown is None else shown.above(_around(direction, 2 * _BY_HAND_DEG, _STEP_DEG))
        if shown is None or not len(near):
            continue
        found, evidence = shown.best(near, prior_near(direction[None], _BY_HAND_DEG))
        measured = _measured(shown, found, math.inf) if evidence > _PROMISING else None
        if measured is not None:
            return replace(measured, name=SET_BY_HAND)
    error_deg = max(ERROR_DEG, spread_deg)
    name = f"{SET_BY_HAND}, its strength estimated"
    return Sun(direction, UNSEEN_RADIUS_DEG, captured.up, None, math.inf, error_deg, name)


def direction_through(points: Sequence[Point], up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], float]:
    """Return the mean direction from shadows to the points that cast them, and the pairs' spread, degrees.

    Args:
        points: Pairs as for `set_sun`.
        up: Unit up direction.

    Raises:
        ValueError: The points are not pairs, or a shadow lies higher than the point that casts it.
    """
    pairs = torch.tensor(points).reshape(-1, 3)
    if len(pairs) % 2 or not len(pairs):
        raise ValueError(f"sun_through: expected pairs of a point and its shadow, found {len(pairs)} points")
    casters, shadows = pairs[::2], pairs[1::2]
    towards = F.normalize(casters - shadows, dim=1)
    if float((towards @ up).min()) < LOWEST_SINE:
        i = int((towards @ up).argmin())
        height = float((casters[i] - shadows[i]) @ up)
        raise ValueError(
            f"sun_through: expected a point that casts a shadow, then its shadow below it; found the first "
            f"{height:.3g} above the second in pair {i + 1}"
        )
    direction = F.normalize(towards.mean(0), dim=0)
    spread = torch.rad2deg((towards @ direction).clamp(-1, 1).acos()).square().mean().sqrt()
    return direction, float(spread)


def _radius_and_ratio(shown: _ShadowEvidence, direction: Float[Tensor, "3"]) -> tuple[float, Float[Tensor, "3"] | None]:
    """Measure a sun's angular radius, degrees, and its irradiance over all other light; None if no edge is seen."""
    fine = _Comparison.of(shown.picture, _FINE)
    cones = (shown.surface.shadows(shown.standing, _cone(direction, radius)) for radius in _RADII_DEG)
    softened = torch.stack([cone.mean(0) for cone in cones])
    by_radius = torch.full((len(_RADII_DEG),), -math.inf)
    blurred = torch.cat([softened, shown.ambient[None]])
    for _ in range(5):  # widths of the reconstruction's blur
        by_radius = torch.maximum(by_radius, fine.of_suns(blurred[:-1], blurred[-1], _STRENGTHS))
        blurred = _blurred(blurred)
    radius = _RADII_DEG[int((by_radius > by_radius.max() - _LIKELIER).int().argmax())]
    ratio = lit_over_shaded(shown.picture, softened[0], shown.ambient)
    return radius, None if ratio is None else _with_bounded_tint(ratio)


def _with_bounded_tint(ratio: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Reduce the tint of a ratio, whose luminance stays, because photographs show shade bluer than it is."""
    luminance = (ratio @ LUMINANCE).clamp_min(1e-6)
    log_tint = (ratio / luminance).clamp_min(1e-3).log()
    tint = (log_tint * (_MAX_TINT / log_tint.abs().max().clamp_min(_MAX_TINT))).exp()
    return luminance * tint / (tint @ LUMINANCE)


def _blurred(visible: Float[Tensor, "k s s"]) -> Float[Tensor, "k s s"]:
    """Blur the edges of shadows by a few texels, as a reconstruction does."""
    for _ in range(2):
        visible = F.avg_pool2d(visible[:, None], 3, 1, 1, count_include_pad=False)[:, 0]
    return visible


def _around(direction: Float[Tensor, "3"], span: float, step: float) -> Float[Tensor, "k 3"]:
    """Return a grid of directions; half width `span` and step in degrees."""
    right, down = tangents(direction)
    count = round(span / step)
    offsets = torch.arange(-count, count + 1) * math.radians(step)
    u, v = (grid.reshape(-1, 1) for grid in torch.meshgrid(offsets, offsets, indexing="ij"))
    return F.normalize(direction + u * right + v * down, dim=1)


def _cone(direction: Float[Tensor, "3"], radius_deg: float) -> Float[Tensor, "k 3"]:
    """Return directions spread evenly over a disc."""
    index = torch.arange(_CONE)
    radii = ((index + 0.5) / _CONE).sqrt() * math.tan(math.radians(radius_deg))
    return F.normalize(direction + vogel_offsets(direction, radii, index), dim=1)


def lit_over_shaded(
    picture: SurfacePicture, visible: Float[Tensor, "s s"], ambient: Float[Tensor, "s s"]
) -> Float[Tensor, "3"] | None:
    """Measure the sun's irradiance over that of all other light at texels on both sides of a shadow's edge.

    Args:
        picture: The surface.
        visible: Share of the sun's light that reaches each texel.
        ambient: Share of all other light that reaches it.

    Returns:
        The ratio of each channel, at least 0; None if no edge is seen.
    """
    ratios = []
    for one in _Comparison.of(picture, _ACROSS, 1).axes:
        edge = one.of(visible[None])[0]
        across = edge.abs() > 0.9
        sign = edge[across].sign()
        log_first, log_second = (picture.log_rgb.reshape(-1, 3)[side[across]] for side in (one.first, one.second))
        change = (log_second - log_first) * sign[:, None]
        first, second = (ambient.flatten()[side[across]] for side in (one.first, one.second))
        lit, shaded = torch.where(sign > 0, second, first), torch.where(sign > 0, first, second)
        ratios.append(change.exp() * shaded[:, None] - lit[:, None])
    found = torch.cat(ratios)
    return found.median(0).values.clamp_min(0) if len(found) else None


def with_sun(light: Light, sun: Sun, *, is_added: bool = False) -> Light:
    """Replace the infinitely distant sources of a light by a sun.

    Args:
        light: The estimated light.
        sun: The sun at the same place. If its ratio is None, it replaces all sources and gets their strength, or 0.6 of
            all other light if that is more.
        is_added: Whether all other light is known, so that it stays as it is. Otherwise the irradiance on the surface
            stays the same.
    """
    others = replace(light, sources=()) if sun.ratio is None else _without_distant_sources(light)
    before, shaded = (one.irradiance(sun.normal[None])[0] for one in (light, others))
    ratio = (before / shaded - 1).clamp_min(_MIN_RATIO_BY_HAND) if sun.ratio is None else sun.ratio
    scale = 1.0 if is_added else float(before @ LUMINANCE) / float((shaded * (1 + ratio)) @ LUMINANCE)
    irradiance = scale * shaded * ratio / float(sun.direction @ sun.normal)
    x, y, z = sun.direction.tolist()
    r, g, b = irradiance.tolist()
    found = LightSource(
        (x, y, z),
        (r, g, b),
        sun.radius_deg,
        sun.error_deg,
        name=sun.name,
        blockers_within=sun.blockers_within,
        distance=sun.distance,
    )
    dimmed = _scaled(others, scale)
    return replace(dimmed, sources=(found, *dimmed.sources))


def without_sun(light: Light, sun: Sun, *, is_added: bool = False) -> Light:
    """Remove the infinitely distant sources of a light, for a place in the shade of a sun.

    Args:
        light: The estimated light.
        sun: The sun that does not reach the place; its normal alone is read.
        is_added: Whether all other light is known, so that it stays as it is. Otherwise the irradiance on the surface
            stays the same.
    """
    others = _without_distant_sources(light)
    before, shaded = (one.irradiance(sun.normal[None])[0] @ LUMINANCE for one in (light, others))
    return others if is_added else _scaled(others, float(before / shaded))


def _without_distant_sources(light: Light) -> Light:
    return replace(light, sources=tuple(one for one in light.sources if math.isfinite(one.distance)))


def _scaled(light: Light, scale: float) -> Light:
    sources = tuple(replace(s, irradiance=tuple(scale * v for v in s.irradiance)) for s in light.sources)
    return replace(light, sources=sources, ambient=scale * light.ambient)
