"""A change of the estimated radiance around a place, per direction: a factor, and light that was missed."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class RatioShares:
    """How much of a ratio between the light of two places is applied to an object's mean colour."""

    level: float
    """Share, in [0, 1], of its gray part, in logarithms: the slope of the true level on the found one."""
    tint: float
    """The same of its tint."""


def belief(distance: float) -> float:
    """Share, in [0, 1], of a correction that is applied at a place so far from those of the training.

    Args:
        distance: 1 is that of the farthest hundredth of the training's places.
    """
    return 1.0 if distance <= 1 else distance**-2


@dataclass(frozen=True)
class RadianceCorrection:
    """Of the k `DIRECTIONS`."""

    gain: Float[Tensor, "k 3"]
    """Factor of the linear radiance."""
    missed: Float[Tensor, "k"]
    """White radiance that is added, over the mean radiance of the estimate."""
    level_sd: float
    """Standard deviation of the level of the corrected irradiance, stops."""
    tint_sd: float
    """The same of its tint, stops: root mean square over the channels."""
    shares: RatioShares
    """What a ratio of corrected lights is worth."""
    distance: float
    """Of the place from those that the network saw in training; above 1 it is unlike them, and is corrected less."""

    def apply(self, radiance: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
        """The corrected radiance; the mean of `radiance` is what `missed` is measured in."""
        return radiance * self.gain + (self.missed * radiance.mean())[:, None]
