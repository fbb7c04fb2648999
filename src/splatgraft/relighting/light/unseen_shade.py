"""Shade that nothing in a capture casts, such as that of a tree outside the views.

A clear sky's sun makes ground several times brighter, and redder. So a place is in such a shade if some of the ground
around it, of the same material, is brighter and redder by that.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.images import LUMINANCE
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.known_sun import clear_ratio
from splatgraft.relighting.light.sun import MAX_GREEN, SURFACES, Sun, draw_surface, find_surfaces, standing_on

# set by hand
_AT_PLACE = 1.5  # object radii from the object's middle within which ground is at its place
_FEWEST = 8  # texels of that ground
_OPEN = 0.9  # share of the sun's light that passes the captured things; ground with less is in their shade
_SUNLIT = 0.03  # share of sunlit ground that shows a shade: 17 places outdoors have 0 in the sun, .06 in a shade


@dataclass(frozen=True)
class OpenGround:
    """m texels of level ground, not in the shade of captured things."""

    points: Float[Tensor, "m 3"]
    """World units."""
    tones: Float[Tensor, "m 3"]
    """Logarithms of luminance, of red over blue, and of green over the geometric mean of red and blue."""
    sunlight: Float[Tensor, "2"]
    """Change of the first two tones from shade to a clear sky's sun."""

    @staticmethod
    def around(captured: CapturedScene, region: BoundingSphere, sun: Sun) -> "OpenGround":
        """Collect the ground of a region.

        Args:
            captured: The scene with all objects that cast shadows during the capture.
            region: Sphere around the place.
            sun: The sun; its strength is not read.
        """
        points, log_rgb = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
        for surface in find_surfaces(captured, region, most=SURFACES):
            picture, standing = draw_surface(captured, surface), standing_on(surface, captured.gaussians, region)
            is_open = picture.valid & (surface.shadows(standing, sun.direction[None])[0] > _OPEN)
            points.append(surface.texels()[is_open])
            log_rgb.append(picture.log_rgb[is_open])
        lit_over_shaded = 1 + clear_ratio(float(sun.direction @ captured.up))
        return OpenGround(torch.cat(points), _tones(torch.cat(log_rgb)), _tones(lit_over_shaded.log())[:2])

    def is_shaded(self, place: BoundingSphere) -> bool:
        """Return whether the ground at an object's place is in the shade of something that was not captured.

        Args:
            place: The object's bounding sphere.
        """
        at_place = (self.points - place.center).norm(dim=1) < _AT_PLACE * place.radius
        if int(at_place.sum()) < _FEWEST:
            return False
        away = self.tones - self.tones[at_place].median(0).values
        is_same_material = away[:, 2].abs() < MAX_GREEN
        is_sunlit = (away[:, :2] / self.sunlight - 1).abs().amax(1) < 0.5  # nearer to sunlit ground than to the place
        return float(is_sunlit[is_same_material].float().mean()) > _SUNLIT


def _tones(log_rgb: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3"]:
    red, green, blue = log_rgb.unbind(-1)
    return torch.stack([(log_rgb.exp() @ LUMINANCE).log(), red - blue, green - 0.5 * (red + blue)], -1)
