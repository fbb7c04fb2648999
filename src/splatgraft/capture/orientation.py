"""Which way is up in a capture, from its cameras and sparse points. Knows nothing about images or files."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.cameras import Cameras
from splatgraft.similarity import Similarity

_PLANE_TILT_DEG = 25.0
_PLANE_SHARE = 0.2
_TRIALS = 2000


def up_from_cameras(cameras: Cameras) -> Float[Tensor, "3"]:
    """The direction that people held upwards: square to all image rows where these tell it, else the mean image up.

    The mean of the cameras' own up axes leans where an orbit is not closed; image rows do not, for people hold the
    horizon level. Rows tell it only if the cameras turned, so both are weighed by how far they did.
    """
    rows = cameras.world_from_camera[:, :3, 0].double()
    mean_up = torch.nn.functional.normalize(-cameras.world_from_camera[:, :3, 1].double().mean(0), dim=0)
    values, vectors = torch.linalg.eigh(rows.T @ rows / len(rows))
    square = vectors[:, 0] * torch.sign(vectors[:, 0] @ mean_up)
    # eigenvalues sum to 1; a turn of at least about 25 degrees around, with rows that are level to a tenth of it
    clear = bool(values[1] > 0.05) and bool(values[0] < 0.1 * values[1])
    agrees = bool(square @ mean_up > math.cos(math.radians(45)))
    return (square if clear and agrees else mean_up).to(cameras.world_from_camera)


def dominant_plane(
    points: Float[Tensor, "m 3"], up: Float[Tensor, "3"], seed: int = 0
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]] | None:
    """Normal n and offset d (n . x = d) of the largest nearly level plane, or None where no plane is clear.

    RANSAC within 25 degrees of `up`, then least squares on the inliers; clear means a fifth of all points.
    """
    if len(points) < 50:
        return None
    x = points.double()
    centre = x.median(0).values
    threshold = 0.01 * (x - centre).norm(dim=1).median()
    generator = torch.Generator().manual_seed(seed)
    triples = x[torch.randint(len(x), (_TRIALS, 3), generator=generator)]
    normals = torch.linalg.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = normals.norm(dim=1, keepdim=True)
    normals = normals / lengths.clamp_min(1e-30)
    normals = normals * torch.sign(normals @ up.double())[:, None]
    level = (normals @ up.double() > math.cos(math.radians(_PLANE_TILT_DEG))) & (lengths[:, 0] > 0)
    if not level.any():
        return None
    normals, offsets = normals[level], (normals[level] * triples[level, 0]).sum(1)
    counts = torch.stack([((x @ n - d).abs() < threshold).sum() for n, d in zip(normals, offsets, strict=True)])
    normal, offset = normals[counts.argmax()], offsets[counts.argmax()]
    inliers = (x @ normal - offset).abs() < threshold
    for _ in range(3):
        if int(inliers.sum()) < _PLANE_SHARE * len(x):
            return None
        middle = x[inliers].mean(0)
        _, _, axes = torch.linalg.svd(x[inliers] - middle, full_matrices=False)
        normal = axes[2] * torch.sign(axes[2] @ up.double())
        offset = normal @ middle
        inliers = (x @ normal - offset).abs() < threshold
    return normal.to(points), offset.to(points)


def convergence_point(cameras: Cameras) -> Float[Tensor, "3"]:
    """The point nearest to all optical axes in the least-squares sense: what an orbit looks at."""
    direction = cameras.world_from_camera[:, :3, 2].double()
    projector = torch.eye(3, dtype=torch.float64) - direction[:, :, None] * direction[:, None, :]
    # a faint pull to the mean camera keeps parallel axes solvable
    ridge = 1e-6 * torch.eye(3, dtype=torch.float64)
    centers = cameras.centers.double()
    right = (projector @ centers[:, :, None]).sum(0)[:, 0] + ridge @ centers.mean(0)
    return torch.linalg.solve(projector.sum(0) + ridge, right).to(cameras.world_from_camera)


def upright(cameras: Cameras, points: Float[Tensor, "m 3"]) -> Similarity:
    """upright_from_world: +z up, the support plane at z = 0 where one is clear, the orbit's centre above the origin.

    The scale makes the median distance of the cameras from what they look at 1, since structure from motion has none.
    """
    up = up_from_cameras(cameras)
    plane = dominant_plane(points, up)
    if plane is not None:
        up = plane[0]
    rotation = _turn_to_z(up)
    centre = convergence_point(cameras)
    distance = (cameras.centers - centre).norm(dim=1).median()
    height = plane[1] if plane is not None else up @ centre
    origin = centre + up * (height - up @ centre)
    scale = float(1 / distance.clamp_min(1e-9))
    return Similarity(scale=scale, rotation=rotation, translation=-scale * (rotation @ origin))


def _turn_to_z(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    helper = torch.eye(3).to(up)[int(up.abs().argmin())]
    x = torch.nn.functional.normalize(torch.linalg.cross(helper, up), dim=0)
    return torch.stack([x, torch.linalg.cross(up, x), up])


def seen_by_most(cameras: Cameras, points: Float[Tensor, "m 3"], share: float = 0.5) -> Bool[Tensor, "m"]:
    """Which points lie inside the pictures of at least `share` of the cameras (occlusion is not looked at)."""
    seen = torch.zeros(len(points))
    for camera in cameras:
        local = points @ camera.camera_from_world[0, :3, :3].T + camera.camera_from_world[0, :3, 3]
        pixels = local @ camera.intrinsics[0].T
        pixels = pixels[:, :2] / pixels[:, 2:].clamp_min(1e-9)
        inside = (pixels >= 0).all(1) & (pixels < camera.sizes[0].to(pixels)).all(1) & (local[:, 2] > 0)
        seen += inside
    return seen >= share * len(cameras)
