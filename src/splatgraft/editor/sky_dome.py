"""The light at a place as a picture of the sky seen from below: the middle is overhead, the rim is the horizon.

The lower end is the viewer's side, so that a light there comes from behind the camera.
"""

import base64
import html
import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.relighting import Light, LightSource

_RADIUS, _SIDE = 90.0, 100.0
"""Radius of the horizon, and half the side of the picture."""
_PIXELS = 64
"""Side of the picture of the ambient light."""
_LOWEST, _HIGH = 25.0, 55.0
"""Degrees above the horizon below which a light is low, and above which it is high."""


@dataclass(frozen=True)
class SkyDome:
    """Orientation of a picture of the sky."""

    up: Float[Tensor, "3"]
    """Unit up direction of the world."""
    forward: Float[Tensor, "3"]
    """Unit direction of view at a right angle to `up`; it is the picture's upper end."""

    @staticmethod
    def seen_along(direction: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> "SkyDome":
        """Return the picture for a viewer who looks along a direction."""
        level = direction - (direction @ up) * up
        if float(level.norm()) < 1e-6:
            level = torch.eye(3)[int(up.abs().argmin())]
            level = level - (level @ up) * up
        return SkyDome(up, torch.nn.functional.normalize(level, dim=0))

    @property
    def right(self) -> Float[Tensor, "3"]:
        """Unit direction of the picture's right."""
        return torch.linalg.cross(self.forward, self.up)

    def point(self, direction: Float[Tensor, "3"]) -> tuple[float, float]:
        """Project a direction to right and down in the picture, over the horizon's radius, at most 1."""
        height = math.asin(max(-1.0, min(1.0, float(direction @ self.up))))
        radius = min(1.0, (math.pi / 2 - height) / (math.pi / 2))
        x, y = float(direction @ self.right), -float(direction @ self.forward)
        length = max(math.hypot(x, y), 1e-9)
        return radius * x / length, radius * y / length

    def direction(self, x: float, y: float) -> Float[Tensor, "3"]:
        """Return the unit direction of a point of the picture, not below the horizon."""
        return self._directions(torch.tensor([[x, y]]))[0]

    def words(self, source: LightSource) -> str:
        """Describe a light's direction, such as 'from the left, high'."""
        direction = torch.tensor(source.direction)
        height = math.degrees(math.asin(max(-1.0, min(1.0, float(direction @ self.up)))))
        x, y = self.point(direction)
        sides = ("from behind you" if y > 0 else "from the back", "from the right" if x > 0 else "from the left")
        side = sides[abs(x) > abs(y)]
        if height > 80:
            return "from overhead"
        return f"{side}, {'low' if height < _LOWEST else 'half high' if height < _HIGH else 'high'}"

    def svg(self, light: Light) -> str:
        """Draw the picture as SVG; sources are dots sized by their share, with numbers as `data-source`."""
        dots = []
        for index, source in enumerate(light.sources):
            x, y = (_RADIUS * value for value in self.point(torch.tensor(source.direction)))
            # share of the light on a surface that faces the source, as in `describe_light`
            share = sum(source.irradiance) / float(light.irradiance(torch.tensor(source.direction)[None]).sum())
            dots.append(
                f'<circle class="light" data-source="{index}" cx="{x:.1f}" cy="{y:.1f}" '
                f'r="{5 + 16 * math.sqrt(share):.1f}" fill="{color_of(source)}" stroke="#222" stroke-width="2">'
                f"<title>{html.escape(source.name)}, {self.words(source)}</title></circle>"
            )
        return (
            f'<svg class="dome" viewBox="{-_SIDE} {-_SIDE} {2 * _SIDE} {2 * _SIDE}" '
            'xmlns="http://www.w3.org/2000/svg"><defs><clipPath id="sky-clip">'
            f'<circle r="{_RADIUS}"/></clipPath></defs><image href="{self._ambient(light)}" x="{-_RADIUS}" '
            f'y="{-_RADIUS}" width="{2 * _RADIUS}" height="{2 * _RADIUS}" clip-path="url(#sky-clip)"/>'
            f'<circle r="{_RADIUS}" fill="none" stroke="#888"/><circle r="{_RADIUS / 2}" fill="none" stroke="#8886"/>'
            f'{"".join(dots)}<text y="-92">far side</text><text y="99">you</text></svg>'
        )

    def _directions(self, points: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        radius = points.norm(dim=1, keepdim=True)
        height = math.pi / 2 * (1 - radius.clamp_max(1))
        level = (points[:, :1] * self.right - points[:, 1:] * self.forward) / radius.clamp_min(1e-9)
        return height.sin() * self.up + height.cos() * level

    def _ambient(self, light: Light) -> str:
        """Encode the ambient light of the upper half as a data URL, relative to its maximum."""
        axis = (torch.arange(_PIXELS) + 0.5) / _PIXELS * 2 - 1
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        radiance = light.ambient_radiance(self._directions(torch.stack([x.ravel(), y.ravel()], 1)))
        picture = (radiance / radiance.max().clamp_min(1e-9)) ** (1 / 2.2) * 0.8
        pixels = (255 * picture.reshape(_PIXELS, _PIXELS, 3)).round().byte().numpy()
        encoded = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1]
        return f"data:image/png;base64,{base64.b64encode(encoded.tobytes()).decode()}"


def color_of(source: LightSource) -> str:
    """Return a light's colour at full brightness, in CSS."""
    peak = max(*source.irradiance, 1e-9)
    r, g, b = (round(255 * max(0.0, value / peak) ** (1 / 2.2)) for value in source.irradiance)
    return f"rgb({r},{g},{b})"
