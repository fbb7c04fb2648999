"""Normalises the frame of a capture: +z up, its support plane at z = 0, and a median camera distance of 1."""

from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.planes import dominant_level_plane
from splatgraft.core.rotations import rotation_to_z
from splatgraft.core.similarity import Similarity


def upright(cameras: Cameras, points: Float[Tensor, "m 3"]) -> Similarity:
    """upright_from_world: +z up, the support plane at z = 0 where one is clear, the median point above the origin.

    The median distance of the cameras from the median point becomes 1, since structure from motion has no scale.

    Args:
        cameras: In any frame.
        points: Sparse points in the same frame; may be empty.
    """
    up = estimate_up(cameras)
    plane = dominant_level_plane(points, up)
    up = up if plane is None else plane.normal
    middle = points.median(0).values if len(points) else cameras.centers.mean(0)
    height = up @ middle if plane is None else plane.offset
    distance = (cameras.centers - middle).norm(dim=1).median()
    scale = float(1 / distance) if distance > 0 else 1.0
    rotation = rotation_to_z(up)
    return Similarity(
        scale=scale, rotation=rotation, translation=-scale * (rotation @ (middle + up * (height - up @ middle)))
    )
