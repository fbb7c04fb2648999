"""What a place sees around it: cube maps of linear radiance rendered from the Gaussians, and their light by direction.

`render_panorama` renders from a point, `panorama_at` first tests whether there is light at a place, and
`surroundings_at` sorts the panorama into `DIRECTIONS`: captured radiance, and what is clipped or unseen.
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras, pinhole
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.rendering import RenderOptions, render

DIRECTIONS = even_directions(320)
"""Unit directions into which all light is sorted: 11 degrees apart, as fine as the surfaces around tell it."""
SOLID_ANGLE = 4 * math.pi / len(DIRECTIONS)
"""Steradians of each direction."""
FARTHEST = 1e4
"""World units; what is farther away counts as so far."""
_TABLE = 64  # pixels; width of a face of the cube map that tells which of the directions is nearest

# rows right, down and forward of each face: +x, -x, +y, -y, +z, -z
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
_FAINTEST = 0.02  # alpha below which a pixel is empty: its colour is noise
_WIDEST = 0.2
"""Standard deviation over distance; wider Gaussians are left out, as splatting's affine approximation smears them."""

# when there is light at a place; set by hand
NEAREST = 0.5
"""Object radii within which Gaussians are left out of the panorama."""
_TEST_SIZE = 24  # pixels; width of a face of the depth cube map that tests whether the place is inside something
_BLOCKED_WITHIN = 0.4  # object radii; a nearer surface blocks the view
_MAX_BLOCKED = 0.6  # share of views; with more blocked the place is inside something
_MIN_COVERAGE = 0.1  # share of the surroundings that must be captured, in [0, 1]
_DARKEST = 2e-3  # mean linear radiance; a darker place has no light

# what counts as captured and as clipped in the surroundings
_SURROUNDINGS_SIZE = 48  # pixels; width of a face of the panorama
_MIN_ALPHA = 0.3  # alpha below which nothing was captured
_CLIPPED = 0.955  # sRGB of the brightest channel from which a camera may have clipped; reconstruction loses a little


@dataclass(frozen=True)
class Panorama:
    """A cube map of s x s pixels per face around one point."""

    radiance: Float[Tensor, "6 s s 3"]
    """Linear rgb, at least 0, from each direction, not premultiplied by alpha."""
    alpha: Float[Tensor, "6 s s"]
    """In [0, 1]; 0 where nothing was captured."""
    directions: Float[Tensor, "6 s s 3"]
    """Unit, from the point outwards, in the scene's frame."""
    solid_angles: Float[Tensor, "6 s s"]
    """Steradians; they sum to 4 pi."""
    distance: Float[Tensor, "6 s s"] | None = None
    """World units from the point to the surfaces; None where it was not asked for."""

    @property
    def coverage(self) -> float:
        """Share of the sphere around the point that the scene covers, in [0, 1]."""
        return float((self.alpha * self.solid_angles).sum() / self.solid_angles.sum())


@dataclass(frozen=True)
class NoLight:
    """The light at a place could not be estimated."""

    reason: str
    """A sentence for a report."""


@dataclass(frozen=True)
class Surroundings:
    """The light around a place, sorted into the k `DIRECTIONS`."""

    radiance: Float[Tensor, "k 3"]
    """Captured linear radiance times the captured share."""
    seen: Float[Tensor, "k"]
    """Share of each direction that some camera photographed, in [0, 1]."""
    clipped: Float[Tensor, "k"]
    """Share that is as bright as a camera records, in [0, 1]; the light there may be brighter."""
    clipped_direction: Float[Tensor, "k 3"]
    """Unit, the middle of that part."""
    distance: Float[Tensor, "k"]
    """World units to what was captured there, the harmonic mean; infinite where nothing was."""


def cube_cameras(center: Float[Tensor, "3"], size: int) -> Cameras:
    """Six cameras of 90 degrees at `center`, `size` pixels wide, that cover all directions once."""
    poses = torch.eye(4).repeat(6, 1, 1)
    poses[:, :3, :3] = _FACES.transpose(1, 2)
    poses[:, :3, 3] = center
    return pinhole(poses.to(center), size / 2, width=size, height=size, prefix="face")


def cube_directions(size: int) -> tuple[Float[Tensor, "6 s s 3"], Float[Tensor, "6 s s"]]:
    """Unit directions and solid angles (steradians) of a cube map's pixels, in the order of `cube_cameras`."""
    x = (torch.arange(size, dtype=torch.float64) + 0.5) / size * 2 - 1
    v, u = torch.meshgrid(x, x, indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1)
    directions = torch.nn.functional.normalize(torch.einsum("hwi,fij->fhwj", rays, _FACES.double()), dim=-1)
    # exact integral over each pixel: corner antiderivative atan(xy / sqrt(1 + x^2 + y^2))
    edge = torch.linspace(-1, 1, size + 1, dtype=torch.float64)
    ey, ex = torch.meshgrid(edge, edge, indexing="ij")
    corner = torch.atan2(ex * ey, (1 + ex * ex + ey * ey).sqrt())
    area = corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1]
    return directions.float(), area.expand(6, size, size).float()


def cube_pixels(directions: Float[Tensor, "n 3"], size: int) -> Int[Tensor, "n"]:
    """The pixel of a cube map, in the order of its flattened faces, that each direction falls into."""
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
        nearest: World units; Gaussians whose centre is nearer are left out.
        with_distance: Whether the panorama has the distance of the surfaces, too.
    """
    away = (scene.means - center.to(scene.means)).norm(dim=-1)
    # the near plane of each face only removes what is behind it: near Gaussians are already left out
    near = max(nearest / math.sqrt(3), 1e-6)
    rendered = render(
        scene.select((away >= nearest) & (scene.scales.max(1).values < _WIDEST * away)),
        cube_cameras(center, size),
        options=RenderOptions(near=near),
        outputs=frozenset({"color", "depth"} if with_distance else {"color"}),
    )
    alpha = rendered.alpha.detach().clamp(0, 1)
    # Gaussians are blended in sRGB, so alpha is divided out before the conversion to linear light
    color = rendered.color.detach().clamp_min(0) / alpha.clamp_min(_FAINTEST)[..., None]
    visible = alpha > _FAINTEST
    directions, solid_angles = cube_directions(size)
    distance = None
    if with_distance:
        # depth runs along each face's axis, which is a direction's largest component
        depth = torch.where(rendered.depth > 0, rendered.depth, torch.inf)
        distance = depth / directions.abs().max(-1).values.to(alpha)
    return Panorama(
        radiance=linear_from_srgb(color) * visible[..., None],
        alpha=alpha * visible,
        directions=directions.to(alpha),
        solid_angles=solid_angles.to(alpha),
        distance=distance,
    )


def panorama_at(scene: Gaussians, place: BoundingSphere) -> Panorama | NoLight:
    """The panorama from the middle of an object's bounding sphere; `scene` is without the object."""
    if scene.count == 0:
        return NoLight("The scene is empty.")
    rendered = render(scene, cube_cameras(place.center, _TEST_SIZE), outputs=frozenset({"depth"}))
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
    """The surroundings of an object's bounding sphere, with what is near it."""
    return surroundings_at(scene, cameras, place.center, nearest=NEAREST * place.radius)


def surroundings_at(scene: Gaussians, cameras: Cameras, center: Float[Tensor, "3"], *, nearest: float) -> Surroundings:
    """Sort what a scene shows around a point into directions.

    What no camera looked at is not seen, whatever the Gaussians show there.

    Args:
        scene: All Gaussians.
        cameras: Of the scene's capture.
        center: World units.
        nearest: World units; Gaussians whose centre is nearer are left out.
    """
    panorama = render_panorama(scene, center, size=_SURROUNDINGS_SIZE, nearest=nearest, with_distance=True)
    assert panorama.distance is not None
    directions, angles = panorama.directions.reshape(-1, 3), panorama.solid_angles.flatten()
    points = center + directions * panorama.distance.reshape(-1, 1).clamp(0, FARTHEST)
    known = _photographed(points, cameras) & (panorama.alpha.flatten() > _MIN_ALPHA)
    radiance = panorama.radiance.reshape(-1, 3)
    clipped = known & (radiance.max(1).values > float(linear_from_srgb(torch.tensor(_CLIPPED))))
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


def nearest_directions(towards: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """Position in `DIRECTIONS` of the one nearest to each unit direction, up to the width of a table's cell, 1.4
    degrees."""
    return _nearest_table()[cube_pixels(towards, _TABLE)]


@cache
def _nearest_table() -> Int[Tensor, "c"]:
    return (cube_directions(_TABLE)[0].reshape(-1, 3) @ DIRECTIONS.T).argmax(1)


def _sum(values: Float[Tensor, "p ..."], index: Int[Tensor, "p"]) -> Float[Tensor, "k ..."]:
    return torch.zeros(len(DIRECTIONS), *values.shape[1:]).index_add_(0, index, values)


def _photographed(points: Float[Tensor, "p 3"], cameras: Cameras) -> Bool[Tensor, "p"]:
    """Whether a point is within some camera's picture; what is in front of it is not tested."""
    found = torch.zeros(len(points), dtype=torch.bool)
    for camera in cameras:
        pixels, depth = camera.project(points)
        found |= (depth > 0) & (pixels > 0).all(1) & (pixels < camera.sizes[0].float()).all(1)
    return found
