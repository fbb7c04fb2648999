"""Cube maps of linear radiance around a place, rendered from the Gaussians, and their sum by direction.

- `render_panorama` renders the cube map at a point.
- `panorama_at` first tests whether there is light at a place.
- `radiance_change` renders the change of the light at a point by shadows on the scene.
- `surroundings_at` sorts the cube map into `DIRECTIONS`: captured radiance, clipped and unseen shares.
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras, pinhole
from splatgraft.core.directions import even_directions, fit_sh
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.rendering import RenderOptions, render

DIRECTIONS = even_directions(320)
"""Unit directions into which all light is sorted, 11 degrees apart; the evidence resolves no finer."""
SOLID_ANGLE = 4 * math.pi / len(DIRECTIONS)
"""Solid angle of each direction, steradians."""
FARTHEST = 1e4
"""Upper bound of distances, world units."""
_TABLE = 64  # pixels; face width of the cube map of nearest directions
_CHANGE_SIZE = 24  # the same of a change, of which harmonics of degree 2 are left

# each face's right, down and forward axes as rows: +x, -x, +y, -y, +z, -z
_FACES = torch.tensor(
    [
        [[0.0, -1, 0], [0, 0, -1], [1, 0, 0]],
        [[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]],
        [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]],
    ]
)
# panoramas; set by hand
_FAINTEST = 0.02  # alpha below which a pixel counts as empty, because its colour is noise
_WIDEST = 0.2  # standard deviation over distance; wider ones are left out: the affine approximation smears them

# tests of a place; set by hand
NEAREST = 0.5
"""Object radii within which Gaussians are left out of the panorama."""
_BLOCKED_WITHIN = 0.4  # object radii; a nearer surface blocks the view
_MAX_BLOCKED = 0.6  # share of blocked directions above which the place is inside something
_MIN_COVERAGE = 0.1  # minimum captured share of the surroundings, in [0, 1]
_DARKEST = 2e-3  # mean linear radiance below which a place has no light

# surroundings
_MIN_ALPHA = 0.3  # alpha below which a direction was not captured
CLIPPED = 0.955
"""sRGB of the brightest channel above which a photo may be clipped; reconstructed white is darker than 1."""


@dataclass(frozen=True)
class Panorama:
    """A cube map of s x s pixels per face around one point."""

    radiance: Float[Tensor, "6 s s 3"]
    """Linear rgb radiance, at least 0, not premultiplied by alpha."""
    alpha: Float[Tensor, "6 s s"]
    """Alpha in [0, 1]; 0 if nothing was captured."""
    directions: Float[Tensor, "6 s s 3"]
    """Unit directions from the point outwards, scene's frame."""
    solid_angles: Float[Tensor, "6 s s"]
    """Solid angles, steradians; they sum to 4 pi."""
    distance: Float[Tensor, "6 s s"] | None = None
    """Distances from the point to the surfaces, world units; None if not requested."""

    @property
    def coverage(self) -> float:
        """Share of the sphere of directions that the scene covers, in [0, 1]."""
        return float((self.alpha * self.solid_angles).sum() / self.solid_angles.sum())


@dataclass(frozen=True)
class NoLight:
    """Failure to estimate the light at a place."""

    reason: str
    """Reason as a sentence for a report."""


@dataclass(frozen=True)
class Surroundings:
    """The light around a place, sorted into the k `DIRECTIONS`."""

    radiance: Float[Tensor, "k 3"]
    """Captured linear radiance times the captured share."""
    seen: Float[Tensor, "k"]
    """Share of each direction that some camera photographed, in [0, 1]."""
    clipped: Float[Tensor, "k"]
    """Share of each direction that is white in the photos, in [0, 1]; its light may be brighter."""
    clipped_direction: Float[Tensor, "k 3"]
    """Unit vectors to the middle of the clipped parts."""
    distance: Float[Tensor, "k"]
    """Harmonic mean distance of the captured surfaces, world units; infinite if nothing was captured."""


def cube_cameras(center: Float[Tensor, "3"], size: int) -> Cameras:
    """Return six cameras of 90 degrees at `center`, `size` pixels wide, which cover all directions once."""
    poses = torch.eye(4).repeat(6, 1, 1)
    poses[:, :3, :3] = _FACES.transpose(1, 2)
    poses[:, :3, 3] = center
    return pinhole(poses.to(center), size / 2, width=size, height=size, prefix="face")


def cube_directions(size: int) -> tuple[Float[Tensor, "6 s s 3"], Float[Tensor, "6 s s"]]:
    """Return unit directions and solid angles (steradians) of a cube map's pixels, in the order of `cube_cameras`."""
    x = (torch.arange(size, dtype=torch.float64) + 0.5) / size * 2 - 1
    v, u = torch.meshgrid(x, x, indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1)
    directions = torch.nn.functional.normalize(torch.einsum("hwi,fij->fhwj", rays, _FACES.double()), dim=-1)
    # exact integral over each pixel, with the antiderivative atan(xy / sqrt(1 + x^2 + y^2)) at its corners
    edge = torch.linspace(-1, 1, size + 1, dtype=torch.float64)
    ey, ex = torch.meshgrid(edge, edge, indexing="ij")
    corner = torch.atan2(ex * ey, (1 + ex * ex + ey * ey).sqrt())
    area = corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1]
    return directions.float(), area.expand(6, size, size).float()


def cube_pixels(directions: Float[Tensor, "n 3"], size: int) -> Int[Tensor, "n"]:
    """Return the cube map pixel of each direction, as a position in the flattened faces."""
    across, down, along = torch.einsum("ni,fji->jnf", directions, _FACES.to(directions)).unbind(0)
    face = along.argmax(1)
    row = torch.arange(len(directions))
    depth = along[row, face]
    u, v = (((axis[row, face] / depth + 1) * 0.5 * size).long().clamp(0, size - 1) for axis in (across, down))
    return (face * size + v) * size + u


def render_panorama(
    scene: Gaussians, center: Float[Tensor, "3"], *, size: int = 64, nearest: float = 0.0, with_distance: bool = False
) -> Panorama:
    """Render the panorama of `scene` from `center`.

    Args:
        scene: All Gaussians.
        center: World units.
        size: Width of a face, pixels.
        nearest: Minimum distance of a Gaussian's centre, world units; nearer ones are left out.
        with_distance: Whether to return the distances of the surfaces, too.
    """
    rendered = render(
        scene.select(_shown_from(scene, center, nearest)),
        cube_cameras(center, size),
        options=_beyond(nearest),
        outputs=frozenset({"color", "depth"} if with_distance else {"color"}),
    )
    alpha = rendered.alpha.detach().clamp(0, 1)
    # Gaussians are blended in sRGB, so alpha is divided out before the conversion to linear light
    color = rendered.color.detach().clamp_min(0) / alpha.clamp_min(_FAINTEST)[..., None]
    visible = alpha > _FAINTEST
    directions, solid_angles = cube_directions(size)
    distance = None
    if with_distance:
        # depth is measured along the face's axis, which is the direction's largest component
        depth = torch.where(rendered.depth > 0, rendered.depth, torch.inf)
        distance = depth / directions.abs().max(-1).values.to(alpha)
    return Panorama(
        radiance=linear_from_srgb(color) * visible[..., None],
        alpha=alpha * visible,
        directions=directions.to(alpha),
        solid_angles=solid_angles.to(alpha),
        distance=distance,
    )


def radiance_change(
    scene: Gaussians, change: Float[Tensor, "n 3"], center: Float[Tensor, "3"], *, nearest: float
) -> Float[Tensor, "9 3"]:
    """Compute the change of the radiance around a point by a change of the scene's colours.

    Args:
        scene: All Gaussians.
        change: Relative change of their linear rgb.
        center: World units.
        nearest: Minimum distance of a Gaussian's centre, world units; nearer ones are left out.

    Returns:
        Coefficients of spherical harmonics of degree 2, linear rgb.
    """
    away, is_changed = (scene.means - center).norm(dim=1), (change != 0).any(1)
    if not bool(is_changed.any()):
        return torch.zeros(9, 3)
    # what is farther than all changes hides none of them
    is_shown = _shown_from(scene, center, nearest) & (away <= away[is_changed].max())
    shown = scene.select(is_shown)
    linear = linear_from_srgb(rgb_from_dc(shown.sh[:, 0]).clamp(0, 1)) * change[is_shown]
    cameras = cube_cameras(center, _CHANGE_SIZE)
    rendered = render(shown, cameras, options=_beyond(nearest), outputs=frozenset(), features=linear)
    directions, solid_angles = cube_directions(_CHANGE_SIZE)
    return fit_sh(directions.reshape(-1, 3), rendered.features.reshape(-1, 3), solid_angles.flatten())


def _shown_from(scene: Gaussians, center: Float[Tensor, "3"], nearest: float) -> Bool[Tensor, "n"]:
    """Select the Gaussians that a panorama at `center` shows."""
    away = (scene.means - center.to(scene.means)).norm(dim=-1)
    return (away >= nearest) & (scene.scales.max(1).values < _WIDEST * away)


def _beyond(nearest: float) -> RenderOptions:
    """Return options that draw all Gaussians farther than `nearest`, even in the corners of a cube map's face."""
    return RenderOptions(near=max(nearest / math.sqrt(3), 1e-6))


def panorama_at(scene: Gaussians, place: BoundingSphere) -> Panorama | NoLight:
    """Render the panorama from the middle of an object's bounding sphere if there is light.

    Args:
        scene: All Gaussians, without the object.
        place: The object's bounding sphere.

    Returns:
        The panorama, or the reason why there is no light.
    """
    if scene.count == 0:
        return NoLight("The scene is empty.")
    rendered = render(scene, cube_cameras(place.center, 24), outputs=frozenset({"depth"}))
    blocked = (rendered.depth > 0) & (rendered.depth < _BLOCKED_WITHIN * place.radius)
    if float(blocked.float().mean()) > _MAX_BLOCKED:
        return NoLight("The object is inside a wall or another thing: there is no light to be found there.")
    panorama = render_panorama(scene, place.center, nearest=NEAREST * place.radius)
    if panorama.coverage < _MIN_COVERAGE:
        return NoLight(f"Only {100 * panorama.coverage:.0f}% of the object's surroundings were captured.")
    mean = float((panorama.radiance.mean(-1) * panorama.alpha * panorama.solid_angles).sum()) / (4 * math.pi)
    if mean < _DARKEST:
        return NoLight("There is no light at the object's place.")
    return panorama


def place_surroundings(scene: Gaussians, cameras: Cameras, place: BoundingSphere) -> Surroundings:
    """Compute the surroundings of an object's bounding sphere, near surfaces included."""
    return surroundings_at(scene, cameras, place.center, nearest=NEAREST * place.radius)


def surroundings_at(scene: Gaussians, cameras: Cameras, center: Float[Tensor, "3"], *, nearest: float) -> Surroundings:
    """Sort the panorama around a point into `DIRECTIONS`.

    Surfaces outside of all photos count as unseen, even if there are Gaussians.

    Args:
        scene: All Gaussians.
        cameras: The cameras of the scene's capture.
        center: World units.
        nearest: Minimum distance of a Gaussian's centre, world units; nearer ones are left out.
    """
    panorama = render_panorama(scene, center, size=48, nearest=nearest, with_distance=True)
    assert panorama.distance is not None
    directions, angles = panorama.directions.reshape(-1, 3), panorama.solid_angles.flatten()
    points = center + directions * panorama.distance.reshape(-1, 1).clamp(0, FARTHEST)
    known = _photographed(points, cameras) & (panorama.alpha.flatten() > _MIN_ALPHA)
    radiance = panorama.radiance.reshape(-1, 3)
    clipped = known & (radiance.max(1).values > float(linear_from_srgb(torch.tensor(CLIPPED))))
    seen = known * panorama.alpha.flatten().clamp(0, 1)
    nearest_direction = nearest_directions(directions)
    total = _sum(angles, nearest_direction).clamp_min(1e-9)
    away = panorama.distance.flatten().clamp(1e-6, FARTHEST)
    towards = _sum((angles * clipped)[:, None] * directions, nearest_direction)
    some = towards.norm(dim=1, keepdim=True) > 1e-6
    return Surroundings(
        radiance=_sum((angles * seen)[:, None] * radiance, nearest_direction) / total[:, None],
        seen=_sum(angles * seen, nearest_direction) / total,
        clipped=_sum(angles * clipped, nearest_direction) / total,
        distance=_sum(angles * seen, nearest_direction).clamp_min(1e-12)
        / _sum(angles * seen / away, nearest_direction),
        clipped_direction=torch.where(some, torch.nn.functional.normalize(towards, dim=1), DIRECTIONS),
    )


def shares_of(direction: Float[Tensor, "3"]) -> Float[Tensor, "k"]:
    """Divide a unit direction among the three nearest of the `DIRECTIONS`, whose mean it is with these shares."""
    three = (DIRECTIONS @ direction).topk(3).indices
    shares = torch.linalg.lstsq(DIRECTIONS[three].T, direction[:, None]).solution[:, 0].clamp_min(0)
    return torch.zeros(len(DIRECTIONS)).index_add(0, three, shares / shares.sum())


def nearest_directions(towards: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """Return the position in `DIRECTIONS` nearest to each unit direction, by a table with cells of 1.4 degrees."""
    return _nearest_table()[cube_pixels(towards, _TABLE)]


@cache
def _nearest_table() -> Int[Tensor, "c"]:
    return (cube_directions(_TABLE)[0].reshape(-1, 3) @ DIRECTIONS.T).argmax(1)


def _sum(values: Float[Tensor, "p ..."], index: Int[Tensor, "p"]) -> Float[Tensor, "k ..."]:
    return torch.zeros(len(DIRECTIONS), *values.shape[1:]).index_add_(0, index, values)


def _photographed(points: Float[Tensor, "p 3"], cameras: Cameras) -> Bool[Tensor, "p"]:
    """Test whether each point lies in some camera's picture; occlusion is ignored."""
    found = torch.zeros(len(points), dtype=torch.bool)
    for camera in cameras:
        pixels, depth = camera.project(points)
        found |= (depth > 0) & (pixels > 0).all(1) & (pixels < camera.sizes[0].float()).all(1)
    return found
