"""Cameras on a smooth path around an object, no further out than the capture went. Knows nothing about pictures."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras, look_at, pinhole

_SMOOTHING = math.radians(20)


@dataclass(frozen=True)
class TurntableOptions:
    """How the camera goes round."""

    frames: int = 60
    """Pictures in one loop."""
    zoom: float = 1.25
    """Focal length over the captured cameras' median: the object is nearer the middle than in the capture."""
    full_circle_gap_deg: float = 75.0
    """Where no captured camera stands over a wider angle than this, the path is an arc, there and back."""


def turntable_cameras(
    cameras: Cameras,
    center: Float[Tensor, "3"],
    *,
    up: Float[Tensor, "3"],
    options: TurntableOptions = TurntableOptions(),
) -> Cameras:
    """A closed path around `center` that looks at it from where captured cameras stood, seen as angle about `up`.

    Distance and height at an angle are means of the captured ones, weighted by nearness in angle, so the path stays
    between captured viewpoints. Size and intrinsics follow the first camera and the median focal length.
    """
    up = torch.nn.functional.normalize(up.double(), dim=0)
    across, along = _horizontal_axes(up)
    offset = cameras.centers.double() - center.double()
    x, y, height = offset @ across, offset @ along, offset @ up
    distance, azimuth = torch.hypot(x, y), torch.atan2(y, x)
    path = _loop_of_angles(azimuth, options)
    turn = torch.remainder(path[:, None] - azimuth[None] + math.pi, 2 * math.pi) - math.pi
    # log weights: far from every camera the nearest one decides, and nothing underflows
    weights = torch.softmax(-0.5 * (turn / _SMOOTHING) ** 2, dim=1)
    ring, level = weights @ distance, weights @ height
    eyes = center.double() + (ring * path.cos())[:, None] * across + (ring * path.sin())[:, None] * along
    eyes = eyes + level[:, None] * up
    width, height_px = cameras.sizes[0].tolist()
    focal = float((cameras.intrinsics[:, 0, 0] * (width / cameras.sizes[:, 0])).median()) * options.zoom
    poses = look_at(eyes, center.double(), up).to(cameras.world_from_camera)
    return pinhole(poses, focal, width=width, height=height_px, prefix="turntable")


def _loop_of_angles(azimuth: Float[Tensor, "v"], options: TurntableOptions) -> Float[Tensor, "frames"]:
    ordered = azimuth.sort().values
    gaps = torch.cat([ordered[1:] - ordered[:-1], ordered[:1] + 2 * math.pi - ordered[-1:]])
    widest = int(gaps.argmax())
    phase = torch.arange(options.frames, dtype=torch.float64) / options.frames
    if float(gaps[widest]) <= math.radians(options.full_circle_gap_deg):
        return ordered[0] + 2 * math.pi * phase
    start = ordered[(widest + 1) % len(ordered)]
    arc = 2 * math.pi - float(gaps[widest])
    # a cosine slows down at both ends, as a hand would
    return start + arc * (1 - (2 * math.pi * phase).cos()) / 2


def _horizontal_axes(up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    other = torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]
    across = torch.nn.functional.normalize(torch.linalg.cross(up, other), dim=0)
    return across, torch.linalg.cross(up, across)
