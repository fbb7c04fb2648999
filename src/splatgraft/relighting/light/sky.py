"""Direction of the sun, and radiance of the whole sky, from the part of a clear sky that the views of a capture show.

A clear sky is brighter around the sun and towards the horizon. The models are the five clear skies of CIE S 011:2003
(types 11 to 15). The brightness of the whole sky is unknown. Views also show other things above the horizon, such as
trees, so each direction shows either the sky or something of any brightness.

The sun's azimuth is sharp by these skies. Its height has a standard error, because other skies differ from the models.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.directions import even_directions, tangents
from splatgraft.core.images import LUMINANCE, linear_from_srgb
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.panorama import CLIPPED
from splatgraft.relighting.light.sun import LOWEST_SINE

_SUNS = even_directions(6400)  # directions in which the sun may stand, 2.5 degrees apart
_HEIGHTS = torch.deg2rad(torch.arange(2.5, 90, 5.0))
_AZIMUTHS = torch.deg2rad(torch.arange(0, 360, 2.5))
_SKIES = (  # CIE S 011: a and b of the gradation from zenith to horizon, c, d and e of the indicatrix around the sun
    (-1.0, -0.55, 10.0, -3.0, 0.45),
    (-1.0, -0.32, 10.0, -3.0, 0.45),
    (-1.0, -0.32, 16.0, -3.0, 0.30),
    (-1.0, -0.15, 16.0, -3.0, 0.30),
    (-1.0, -0.15, 24.0, -2.8, 0.15),
)
_HEIGHT_SD_DEG = 15.0  # standard error of the sun's height, fitted by benchmarks/fit_sky.py

# set by hand
_CELLS = even_directions(1600)  # directions into which pixels are sorted, 5 degrees apart
_EVERY, _FEWEST = 3, 4  # stride of the pixels, and fewest pixels of a cell
_SD = 0.2  # standard deviation of the logarithm of a sky's luminance
_IS_SKY = 0.75  # prior probability that a cell shows the sky
_ANY = 0.2  # density of the logarithm of the luminance of other things
_CLEAR_FROM = 19.2  # log likelihood from which a sky counts as clear
_BRIGHTNESS = torch.arange(-5.0, 5.0, 0.1)  # bins of the logarithm of a cell's luminance over that of the model
_SKY_BRIGHTNESS = _BRIGHTNESS[20:-20:2]  # brightnesses of the whole sky that are tried, in the same unit


def suns_above(up: Float[Tensor, "3"]) -> Float[Tensor, "k 3"]:
    """Return the unit directions above the horizon in which the sun may stand, 2.5 degrees apart."""
    return _SUNS[_SUNS @ up > LOWEST_SINE]


@dataclass(frozen=True)
class ClearSky:
    """A clear sky of the CIE."""

    kind: tuple[float, ...]
    """One of `_SKIES`."""
    sun: Float[Tensor, "3"]
    """Unit vector towards the sun, which is not part of the sky."""
    up: Float[Tensor, "3"]
    """Unit."""
    color: Float[Tensor, "3"]
    """Linear rgb radiance where the pattern of the kind is 1."""

    def radiance(self, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Compute the linear rgb radiance from unit directions; below the horizon it is that of the horizon."""
        sines = (directions @ self.up).clamp_min(LOWEST_SINE)
        return _pattern(self.kind, sines, (directions @ self.sun).clamp(-1, 1))[:, None] * self.color


def _pattern(kind: tuple[float, ...], sines: Tensor, cosines: Tensor) -> Tensor:
    """Compute the relative luminance of a clear sky.

    Args:
        kind: One of `_SKIES`.
        sines: Sines of heights above the horizon.
        cosines: Cosines of angles to the sun; both are broadcast.
    """
    a, b, c, d, e = kind
    around = 1 + c * ((d * cosines.acos()).exp() - math.exp(d * math.pi / 2)) + e * cosines.square()
    return (1 + a * (b / sines).exp()) * around


@dataclass(frozen=True, eq=False)
class SkyEvidence:
    """Brightness that the views show above the horizon, in b cells."""

    directions: Float[Tensor, "b 3"]
    """Unit vectors to the middles of the cells, scene's frame."""
    colors: Float[Tensor, "b 3"]
    """Linear rgb of the pixel of median luminance."""
    clipped: Bool[Tensor, "b"]
    """Whether the cell is clipped; its true luminance is then unknown, but not lower."""
    up: Float[Tensor, "3"]
    """Unit up direction of the scene."""

    @property
    def log_luminance(self) -> Float[Tensor, "b"]:
        """Logarithm of linear luminance."""
        return (self.colors @ LUMINANCE).clamp_min(1e-3).log()

    @property
    def sines(self) -> Float[Tensor, "b"]:
        """Sines of the cells' heights above the horizon."""
        return (self.directions @ self.up).clamp_min(LOWEST_SINE)

    @cached_property
    def by_height(self) -> Float[Tensor, "h a"]:
        """Log likelihood of clear skies, as of `log_likelihoods`, with the sun at `_HEIGHTS` and `_AZIMUTHS`."""
        right, ahead = tangents(self.up)
        level = _AZIMUTHS.cos()[:, None] * right + _AZIMUTHS.sin()[:, None] * ahead
        suns = _HEIGHTS.cos()[:, None, None] * level + _HEIGHTS.sin()[:, None, None] * self.up
        return self.log_likelihoods(suns.reshape(-1, 3)).reshape(len(_HEIGHTS), -1)

    def log_density(self, suns: Float[Tensor, "k 3"]) -> Float[Tensor, "k"]:
        """Compute the log density of the sun in k unit directions, up to a constant.

        It is the likelihood, averaged over heights by the standard error of the height.
        """
        kernel = (-0.5 * ((_HEIGHTS[:, None] - _HEIGHTS) / math.radians(_HEIGHT_SD_DEG)).square()).log_softmax(1)
        averaged = (kernel[:, :, None] + self.by_height).logsumexp(1)
        right, ahead = tangents(self.up)
        azimuth = torch.atan2(suns @ ahead, suns @ right) % (2 * math.pi)
        height = (suns @ self.up).clamp(-1, 1).asin()
        # from -1 to 1 between the first and the last azimuth, which is the first again, and between the heights
        at = torch.stack([azimuth / math.pi - 1, 2 * (height - _HEIGHTS[0]) / (_HEIGHTS[-1] - _HEIGHTS[0]) - 1], -1)
        around = torch.cat([averaged, averaged[:, :1]], 1)
        return F.grid_sample(around[None, None], at[None, None], padding_mode="border", align_corners=True)[0, 0, 0]

    @property
    def is_clear(self) -> bool:
        """Whether the sky counts as clear."""
        return float(self.by_height.max()) > _CLEAR_FROM

    @staticmethod
    def of(captured: CapturedScene) -> "SkyEvidence":
        """Collect what the views of a capture show above the horizon."""
        tree, cells, colors = KDTree(_CELLS.numpy()), [], []
        for camera, drawn in captured.views:
            rays = torch.nn.functional.normalize(camera.world_rays()[::_EVERY, ::_EVERY], dim=-1)
            shown = (rays @ captured.up > LOWEST_SINE) & (drawn.alpha[0, ::_EVERY, ::_EVERY] > 0.9)
            cells.append(torch.from_numpy(tree.query(rays[shown].numpy())[1]))
            colors.append(drawn.color[0, ::_EVERY, ::_EVERY][shown].clamp(0, 1))
        cell, color = torch.cat(cells), torch.cat(colors)
        linear = linear_from_srgb(color)
        order = (linear @ LUMINANCE).argsort()
        order = order[cell[order].argsort(stable=True)]
        counts = cell.unique(return_counts=True)[1]
        middle = order[counts.cumsum(0) - (counts + 1) // 2][counts >= _FEWEST]
        return SkyEvidence(_CELLS[cell[middle]], linear[middle], color[middle].amax(1) > CLIPPED, captured.up)

    def log_likelihoods(self, suns: Float[Tensor, "k 3"]) -> Float[Tensor, "k"]:
        """Compare clear skies with the sun in k unit directions with brightness that does not depend on direction.

        Returns:
            Log likelihoods of the skies minus that without a sky, 0 if the views show nothing above the horizon.
        """
        if not len(self.directions):
            return torch.zeros(len(suns))
        cosines = (suns @ self.directions.T).clamp(-1, 1)
        found = torch.stack([self._under(kind, cosines)[0] for kind in _SKIES]).amax(0)
        return found - self._without_sky()

    def sky_with(self, sun: Float[Tensor, "3"]) -> ClearSky:
        """Find the likeliest clear sky with the sun in a unit direction."""
        cosines = (sun @ self.directions.T).clamp(-1, 1)
        found = [(kind, *self._under(kind, cosines[None])) for kind in _SKIES]
        kind, _, brightness = max(found, key=lambda one: float(one[1]))
        off = self.log_luminance - _pattern(kind, self.sines, cosines).log() - brightness
        is_sky = (~self.clipped & (off.abs() < 2 * _SD)).float()
        # the colour of one more cell is white, for a sky that is clipped everywhere
        tint = 1 + is_sky @ (self.colors / (self.colors @ LUMINANCE).clamp_min(1e-3)[:, None])
        return ClearSky(kind, sun, self.up, brightness.exp() * tint / (tint @ LUMINANCE))

    def _under(
        self, kind: tuple[float, ...], cosines: Float[Tensor, "k b"]
    ) -> tuple[Float[Tensor, "k"], Float[Tensor, "k"]]:
        """Compare the cells with one kind of sky.

        Args:
            kind: One of `_SKIES`.
            cosines: Cosines of the angles between k suns and the cells.

        Returns:
            The log likelihood at the likeliest brightness, and the logarithm of that brightness.
        """
        middle = self.log_luminance.median()
        off = self.log_luminance - middle - _pattern(kind, self.sines, cosines).log()
        # the likelihood depends on the histogram of these differences alone
        step, count = float(_BRIGHTNESS[1] - _BRIGHTNESS[0]), len(_BRIGHTNESS)
        position = ((off - _BRIGHTNESS[0]) / step).round().long().clamp(0, count - 1)
        position += torch.arange(len(off))[:, None] * count
        z = (_BRIGHTNESS[:, None] - _SKY_BRIGHTNESS) / _SD
        density = (-0.5 * z.square()).exp() / (_SD * math.sqrt(2 * math.pi))
        log_density = (_IS_SKY * density + (1 - _IS_SKY) * _ANY).log()
        log_share_brighter = (_IS_SKY * 0.5 * torch.erfc(z / math.sqrt(2)) + (1 - _IS_SKY) * 0.5).log()
        total = torch.zeros(len(off), len(_SKY_BRIGHTNESS))
        for which, table in ((~self.clipped, log_density), (self.clipped, log_share_brighter)):
            histogram = position[:, which].flatten().bincount(minlength=len(off) * count).reshape(-1, count)
            total += histogram.float() @ table
        likeliest = total.max(1)
        return likeliest.values, _SKY_BRIGHTNESS[likeliest.indices] + middle

    def _without_sky(self) -> float:
        """Compute the log likelihood of the cells if each is as bright as any other."""
        seen, share = self.log_luminance[~self.clipped], self.clipped.float().mean()
        density = (-0.5 * ((seen[:, None] - seen) / _SD).square()).exp() / (_SD * math.sqrt(2 * math.pi))
        others = (density.sum(1) - density.diagonal()) / max(len(seen) - 1, 1)
        log_density = (_IS_SKY * others + (1 - _IS_SKY) * _ANY).log().sum()
        return float(log_density + self.clipped.sum() * (_IS_SKY * share + (1 - _IS_SKY) * 0.5).log())


def clear_sky_evidence(captured: CapturedScene) -> SkyEvidence | None:
    """Return what the views show above the horizon if that is a clear sky."""
    evidence = SkyEvidence.of(captured)
    return evidence if evidence.is_clear else None
