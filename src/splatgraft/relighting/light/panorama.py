"""What surrounds a point of a scene: six square renders in linear light, and what is unseen. Picks no light."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.rendering import RenderOptions, render

# right, down and forward of each face: +x, -x, +y, -y, +z, -z
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
# under this much opacity the colour of a pixel is noise
_FAINTEST = 0.02
# standard deviation over distance: what is wider is smeared over half a face by the affine approximation of splatting
_WIDEST = 0.2


@dataclass(frozen=True)
class Panorama:
    """A cube map of s x s pixels per face around one point."""

    radiance: Float[Tensor, "6 s s 3"]
    """Linear light from each direction, of what is there (not darkened where it is half transparent); at least 0."""
    alpha: Float[Tensor, "6 s s"]
    """How much is there, in [0, 1]: 0 where the capture never saw anything."""
    directions: Float[Tensor, "6 s s 3"]
    """Unit, from the point outwards, in the scene's frame."""
    solid_angles: Float[Tensor, "6 s s"]
    """Steradians; they sum to 4 pi."""

    @property
    def coverage(self) -> float:
        """Share of the sphere around the point that the scene covers, in [0, 1]."""
        return float((self.alpha * self.solid_angles).sum() / self.solid_angles.sum())


def cube_cameras(center: Float[Tensor, "3"], size: int) -> Cameras:
    """Six cameras of 90 degrees at `center` that together see everything once."""
    poses = torch.eye(4).repeat(6, 1, 1)
    poses[:, :3, :3] = _FACES.transpose(1, 2)
    poses[:, :3, 3] = center
    return pinhole(poses.to(center), size / 2, width=size, height=size, prefix="face")


def cube_directions(size: int) -> tuple[Float[Tensor, "6 s s 3"], Float[Tensor, "6 s s"]]:
    """Unit directions and solid angles of the pixels of a cube map, in the order of `cube_cameras`."""
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


def render_panorama(scene: Gaussians, center: Float[Tensor, "3"], *, size: int = 64, nearest: float = 0.0) -> Panorama:
    """What `scene` looks like from `center`; Gaussians centred nearer than `nearest` (world units) are left out."""
    distance = (scene.means - center.to(scene.means)).norm(dim=-1)
    far_enough = (distance >= nearest) & (scene.scales.max(1).values < _WIDEST * distance)
    # the plane of each face only has to keep out what is behind it: distance was taken care of above
    near = max(nearest / math.sqrt(3), 1e-6)
    seen = render(scene.select(far_enough), cube_cameras(center, size), options=RenderOptions(near=near))
    alpha = seen.alpha.detach().clamp(0, 1)
    # Gaussians are blended in sRGB: the colour of what is there comes first, its linear light second
    color = seen.color.detach().clamp_min(0) / alpha.clamp_min(_FAINTEST)[..., None]
    there = alpha > _FAINTEST
    directions, solid_angles = cube_directions(size)
    return Panorama(
        radiance=linear_from_srgb(color) * there[..., None],
        alpha=alpha * there,
        directions=directions.to(alpha),
        solid_angles=solid_angles.to(alpha),
    )
