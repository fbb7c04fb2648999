"""Cameras on a smooth path around an object, within the range of the captured viewpoints."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.directions import tangents

# set by hand
_FULL_CIRCLE_GAP_DEG = 75.0  # widest gap between captured azimuths for a full circle; beyond it the path is an arc
_SMOOTHING_DEG = 20.0  # standard deviation of the weights, in azimuth, that average captured distances and heights


@dataclass(frozen=True)
class TurntableOptions:
    """Options of the camera path; the defaults are set by hand."""

    frames: int = 60
    """Number of frames in one loop."""
    zoom: float = 1.25
    """Focal length over the median of the captured cameras."""
    start: Float[Tensor, "3"] | None = None
    """Direction from the centre towards the first frame's camera, met as nearly as the path allows; None: any."""


def turntable_cameras(
    cameras: Cameras,
    center: Float[Tensor, "3"],
    *,
    up: Float[Tensor, "3"],
    options: TurntableOptions = TurntableOptions(),
) -> Cameras:
    """Make a closed path of cameras around `center` that look at it.

    Distance and height at an azimuth are means over the captured cameras, weighted by nearness in azimuth, so that the
    path stays between captured viewpoints. The path is a full circle, or an arc back and forth if the captured azimuths
    leave a gap of more than 75 degrees. Pictures have the size of the first captured one.
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
    # softmax of log weights does not underflow far from all cameras
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
    # by a cosine the motion slows down at both ends
    return start + arc * (1 - (2 * math.pi * phase).cos()) / 2
