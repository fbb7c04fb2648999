"""Cameras on a smooth path around an object, within the range of the captured viewpoints."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.directions import tangents

_FULL_CIRCLE_GAP_DEG = 75.0
"""With a wider angle than this without captured cameras, the path is an arc back and forth; set by hand."""
_SMOOTHING_DEG = 20.0
"""Standard deviation, in angle, of the weights by which captured distances and heights are averaged; set by hand."""


@dataclass(frozen=True)
class TurntableOptions:
    """Options of the camera path; numbers set by hand."""

    frames: int = 60
    """Frames in one loop."""
    zoom: float = 1.25
    """Focal length over the median of the captured cameras."""
    start: Float[Tensor, "3"] | None = None
    """Direction from the centre of the first frame's camera, as near as the path comes to it; None: any."""


def turntable_cameras(
    cameras: Cameras,
    center: Float[Tensor, "3"],
    *,
    up: Float[Tensor, "3"],
    options: TurntableOptions = TurntableOptions(),
) -> Cameras:
    """Make a closed path of cameras around `center` that look at it.

    Distance and height at an azimuth are means of the captured ones, weighted by nearness in azimuth, so that the path
    stays between captured viewpoints. Pictures have the size of the first captured one.
    """
    up = torch.nn.functional.normalize(up.double(), dim=0)
    across, along = tangents(up)
    offset = cameras.centers.double() - center.double()
    x, y, height = offset @ across, offset @ along, offset @ up
    distance, azimuth = torch.hypot(x, y), torch.atan2(y, x)
    path = _loop_of_angles(azimuth, options.frames)
    if options.start is not None:
        start = options.start.to(up)
        turned = torch.cos(path - torch.atan2(start @ along, start @ across))
        path = path.roll(-int(turned.argmax()))
    difference = torch.remainder(path[:, None] - azimuth[None] + math.pi, 2 * math.pi) - math.pi
    # softmax of log weights: no underflow far from all cameras, where the nearest one decides
    weights = torch.softmax(-0.5 * (difference / math.radians(_SMOOTHING_DEG)) ** 2, dim=1)
    ring, level = weights @ distance, weights @ height
    eyes = center.double() + (ring * path.cos())[:, None] * across + (ring * path.sin())[:, None] * along
    eyes = eyes + level[:, None] * up
    width, height_px = cameras.sizes[0].tolist()
    focal = float((cameras.intrinsics[:, 0, 0] * (width / cameras.sizes[:, 0])).median()) * options.zoom
    poses = look_at(eyes, center.double(), up).to(cameras.world_from_camera)
    return pinhole(poses, focal, width=width, height=height_px, prefix="turntable")


def _loop_of_angles(azimuth: Float[Tensor, "v"], frames: int) -> Float[Tensor, "frames"]:
    ordered = azimuth.sort().values
    gaps = torch.cat([ordered[1:] - ordered[:-1], ordered[:1] + 2 * math.pi - ordered[-1:]])
    widest = int(gaps.argmax())
    phase = torch.arange(frames, dtype=torch.float64) / frames
    if float(gaps[widest]) <= math.radians(_FULL_CIRCLE_GAP_DEG):
        return ordered[0] + 2 * math.pi * phase
    start = ordered[(widest + 1) % len(ordered)]
    arc = 2 * math.pi - float(gaps[widest])
    # a cosine, so that the motion slows down at both ends
    return start + arc * (1 - (2 * math.pi * phase).cos()) / 2
