"""Whether posed views can be reconstructed from at all: their number, and the parallax between them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import focus_point
from splatgraft.core.posed_images import PosedImages

_POINTS = 256
_CAMERAS = 128
"""At most so many of each are compared, evenly spaced in their order."""


@dataclass(frozen=True)
class CoverageRule:
    """What a reconstruction needs at least; a good capture has ten times as much."""

    views: int = 8
    """A closed ring of 8 has a view every 45 degrees, with which each surface is seen by three."""
    parallax_deg: float = 3.0
    """Angle at which the outermost cameras see a point. At 3 degrees one pixel of error, at a focal length of 1000 px,
    moves a point by 2% of its distance."""


def require_coverage(capture: PosedImages, name: str, *, rule: CoverageRule = CoverageRule()) -> None:
    """Refuse views that are too few or too close together.

    Args:
        capture: Posed views; without points, parallax is measured at the place that the cameras look at.
        name: The capture, for the message.
        rule: What is needed.

    Raises:
        ValueError: With what is needed, in number and parallax, and what was found.
    """
    needed = (
        f"expected at least {rule.views} posed views with a parallax of {rule.parallax_deg:g} degrees or more "
        f"(40 or more views from all around are usual)"
    )
    if len(capture) < rule.views:
        raise ValueError(f"{name}: {needed}, found {len(capture)}")
    parallax = median_parallax_deg(capture.cameras, capture.points)
    if parallax is not None and parallax < rule.parallax_deg:
        raise ValueError(
            f"{name}: {needed}, found {len(capture)} views with {parallax:.2g} degrees: "
            "the cameras stand in one place, or their positions are missing"
        )


def median_parallax_deg(cameras: Cameras, points: Float[Tensor, "m 3"]) -> float | None:
    """The angle between the outermost cameras that see a point, in the median over points; None where unknown.

    Args:
        cameras: In the points' frame.
        points: Where there are none that two cameras see, the focus point of the cameras serves; where the cameras look
            outwards, there is none either, and only cameras in one place are known to have no parallax.
    """
    some = cameras.spread(_CAMERAS)
    centers = some.centers.double()
    extent = float((centers - centers.mean(0)).norm(dim=1).max())
    if extent <= 1e-6 * max(1.0, float(centers.abs().max())):
        return 0.0
    chosen = points[torch.linspace(0, len(points) - 1, min(_POINTS, len(points))).long()].double()
    seen = _seen(some, chosen)
    several = seen.sum(0) >= 2
    if bool(several.any()):
        return float(_widest_deg(centers, chosen[several], seen[:, several]).median())
    try:
        focus = focus_point(some).double()[None]
    except ValueError:
        return None
    return float(_widest_deg(centers, focus, torch.ones(len(some), 1, dtype=torch.bool))[0])


def _seen(cameras: Cameras, points: Float[Tensor, "m 3"]) -> Tensor:
    """Which camera has which point in its image, (v, m)."""
    poses = cameras.camera_from_world.double()
    x = torch.einsum("vij,mj->vmi", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    pixels = torch.einsum("vij,vmj->vmi", cameras.intrinsics.double(), x)
    pixels = pixels[..., :2] / pixels[..., 2:].clamp_min(1e-9)
    inside = (pixels >= 0).all(-1) & (pixels < cameras.sizes[:, None].double()).all(-1)
    return inside & (x[..., 2] > 0)


def _widest_deg(centers: Float[Tensor, "v 3"], points: Float[Tensor, "m 3"], seen: Tensor) -> Float[Tensor, "m"]:
    """The widest angle at each point between two cameras that see it, degrees."""
    rays = torch.nn.functional.normalize(centers[:, None] - points, dim=-1)
    cosines = torch.einsum("vmi,wmi->mvw", rays, rays)
    both = seen.T[:, :, None] & seen.T[:, None, :]
    least = torch.where(both, cosines, torch.ones_like(cosines)).flatten(1).min(1).values
    return torch.rad2deg(torch.acos(least.clamp(-1, 1)))
