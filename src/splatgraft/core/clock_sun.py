"""The values `Geotag`, time, place and compass of a photograph, and `ClockSun`, the sun's direction that follows."""

from dataclasses import dataclass
from datetime import datetime, timedelta

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras


@dataclass(frozen=True)
class Geotag:
    """Time, place and compass of one photograph by its metadata; unknown ones are None."""

    gps_time: datetime | None = None
    """Time of the satellites, UTC."""
    camera_time: datetime | None = None
    """Local time of the camera's clock, without an offset."""
    camera_offset: timedelta | None = None
    """Offset of the camera's clock from UTC."""
    position: tuple[float, float, float | None] | None = None
    """Latitude and longitude, degrees, north and east positive, and altitude, metres, or None."""
    heading_deg: float | None = None
    """Direction in which the camera looks, degrees from north clockwise."""
    heading_is_true: bool = False
    """Whether the heading is from true north, otherwise from magnetic north."""
    broken: tuple[str, ...] = ()
    """Names of the EXIF tags with impossible values."""


@dataclass(frozen=True)
class SunCandidate:
    """The sun at one reading of the clocks."""

    time: datetime
    """Median time of the photos, with its offset from UTC."""
    clock: str
    """Clock that gave the time, for messages."""
    height_deg: float
    """Height above the horizon, degrees; below 0 the sun has set."""
    direction: tuple[float, float, float] | None = None
    """Unit vector towards the sun, world frame; None if the azimuth is unknown."""

    def describe(self, side: str = "") -> str:
        """Describe the candidate in a clause that ends with `side`, such as "from the left in the first photo"."""
        when = f"{self.time.day} {self.time:%B %Y, %H:%M %Z} by {self.clock}"
        if self.height_deg < 0:
            return f"{when}: the sun has set"
        return f"{when}: sun {self.height_deg:.1f} degrees high{side and ', '}{side}"


@dataclass(frozen=True)
class ClockSun:
    """The sun's direction by the time, the place and the compass of a capture's photos."""

    candidates: tuple[SunCandidate, ...]
    """One or more readings of the clocks, the most trusted first."""
    up: tuple[float, float, float]
    """Unit up direction by which the heights count, world frame."""
    error_deg: float
    """Standard error of the directions, degrees, or of the heights if no azimuth is known."""
    height_error_deg: float
    """Standard error of the heights above the horizon, degrees."""
    source: str
    """Evidence for the world's orientation, for messages."""
    metres_per_unit: float | None = None
    """Size of the world unit by the GPS positions; None if these do not give it."""

    def describe(self, cameras: Cameras) -> str:
        """Describe all candidates in one sentence; `cameras` are those of the capture."""
        suns = "; or ".join(one.describe(self._side(one, cameras)) for one in self.candidates)
        return f"{suns} (orientation by {self.source}, to {self.error_deg:.0f} degrees)"

    def _side(self, sun: SunCandidate, cameras: Cameras) -> str:
        """Name the side of the first photo from which the sun shines."""
        if sun.direction is None:
            return ""
        right, direction = cameras.world_from_camera[0, :3, 0].double(), torch.tensor(sun.direction).double()
        ahead = torch.linalg.cross(torch.tensor(self.up).double(), right)
        x, z = float(direction @ right), float(direction @ ahead)
        side = ("from the right" if x > 0 else "from the left") if abs(x) > abs(z) else "from ahead"
        return f"{'from behind' if z < -abs(x) else side} in the first photo"


def clock_directions(clock: ClockSun | None) -> Float[Tensor, "c 3"]:
    """Return the directions of the clock's candidates that are above the horizon, the most trusted first."""
    candidates = clock.candidates if clock is not None else ()
    shown = [one.direction for one in candidates if one.direction is not None and one.height_deg > 0]
    return torch.tensor(shown).reshape(-1, 3)
