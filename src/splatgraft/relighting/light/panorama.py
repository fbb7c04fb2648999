"""Panorama around a point of a scene: a cube map of linear radiance and alpha, rendered from the Gaussians."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core.cameras import Cameras, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.rendering import RenderOptions, render

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
# set by hand
_FAINTEST = 0.02
"""Alpha below which a pixel is empty: its colour is noise."""
_WIDEST = 0.2
"""Standard deviation over distance; wider Gaussians are left out, as splatting's affine approximation smears them."""


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


def _far_enough(scene: Gaussians, center: Float[Tensor, "3"], nearest: float) -> Gaussians:
    """The Gaussians at least `nearest` world units from `center` that are not too wide for their distance."""
    distance = (scene.means - center.to(scene.means)).norm(dim=-1)
    return scene.select((distance >= nearest) & (scene.scales.max(1).values < _WIDEST * distance))


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
    # the near plane of each face only removes what is behind it: near Gaussians are already left out
    near = max(nearest / math.sqrt(3), 1e-6)
    rendered = render(
        _far_enough(scene, center, nearest),
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
        distance = rendered.depth.detach() / directions.abs().max(-1).values.to(alpha)
    return Panorama(
        radiance=linear_from_srgb(color) * visible[..., None],
        alpha=alpha * visible,
        directions=directions.to(alpha),
        solid_angles=solid_angles.to(alpha),
        distance=distance,
    )
