"""The light at a place as an environment map and lamps, for programs that light meshes.

Photographed directions of the map have the scene's own radiance in full resolution, all others the radiance of the
estimate. The lamps are not in the map: their directions get the radiance of their neighbours. `with_lamps` adds them
as discs, for programs that take one file.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import rotation_between
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.estimate import EstimatedLight, estimate_light
from splatgraft.relighting.light.light import Light, angular_radius_deg
from splatgraft.relighting.light.panorama import (
    DIRECTIONS,
    NEAREST,
    NoLight,
    cube_pixels,
    nearest_directions,
    render_panorama,
)
from splatgraft.relighting.light.sun import Point

_RADIUS = 1 / 8
"""Radius of a place without an object, over the cameras' median distance. Evidence is taken within 8 radii, which then
covers the whole region that the cameras look at."""
_BLENDER_FROM_DOWN_Y = torch.tensor([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]])
"""Rotation from the axes of a capture whose up is -y to those of Blender after it opened the exported .glb."""
_SMOOTH_RAD = math.radians(8.0)  # width of the kernel that interpolates between `DIRECTIONS`; set by hand
_CHUNK = 65_536  # directions interpolated at a time; bounds memory

# lamps in the map
_MIN_RADIUS_DEG = 0.5  # the sun's own disc has two pixels in a map of 512 rows, too few for a program that samples it
_MAX_RADIANCE = 60_000.0  # three.js keeps a map in half floats, which end at 65,504


@dataclass(frozen=True)
class EnvironmentLight:
    """The light at a place of a scene: lamps, and a map of the radiance of all other light."""

    light: Light
    """The lamps (`sources`) and the ambient light, in the axes of the capture."""
    radiance: Float[Tensor, "h w 3"]
    """Linear rgb without the lamps, at least 0; a white sky has 1. Layout: `equirectangular_directions`."""
    map_from_capture: Float[Tensor, "3 3"]
    """Rotation from the axes of the capture to those of the map."""

    def with_lamps(self) -> Float[Tensor, "h w 3"]:
        """Compute the map with each lamp as a disc of even radiance, which gives the lamp's irradiance.

        A disc has the lamp's own size, but at least one degree, one pixel, and the size at which its radiance is that
        of half floats.
        """
        height, _, _ = self.radiance.shape
        pixel, directions, total = math.pi / height, equirectangular_directions(height), self.radiance
        solid_angles = pixel**2 * directions[..., :2].norm(dim=-1)
        for source in self.light.rotated(self.map_from_capture).sources:
            towards, irradiance = torch.tensor(source.direction), torch.tensor(source.irradiance)
            darkest = angular_radius_deg(max(source.irradiance) / _MAX_RADIANCE)
            radius = max(math.radians(max(source.angular_radius_deg, darkest, _MIN_RADIUS_DEG)), pixel / 2)
            apart = 2 * ((directions - towards).norm(dim=-1) / 2).clamp_max(1).asin()
            share = ((radius - apart) / pixel + 0.5).clamp(0, 1)  # the edge is one pixel wide
            on_facing_plane = (share * solid_angles * (directions @ towards).clamp_min(0)).sum()
            total = total + share[..., None] * (irradiance / on_facing_plane)
        return total


def light_at(
    scene: Gaussians, cameras: Cameras, place: Sequence[float], *, radius: float | None = None, height: int = 512
) -> EnvironmentLight:
    """Estimate the light at a place of a scene, for a map whose +z is up, as in Blender after it opened the `.glb`.

    Args:
        scene: The scene, without anything that stands at the place.
        cameras: The cameras of its capture.
        place: x y z, world units.
        radius: Half the width of what will stand there, world units; an eighth of the cameras' distance if not given.
            Gaussians nearer than half of it are left out.
        height: Rows of the map, which is twice as wide.

    Raises:
        ValueError: The scene shows no light around the place.
    """
    captured, sphere = CapturedScene(scene, cameras), place_at(place, cameras, radius)
    found = environment_light(captured, sphere, map_from_capture=upright_from_capture(captured.up), height=height)
    if isinstance(found, NoLight):
        raise ValueError(f"place: expected one with light around it, found {list(place)}. {found.reason}")
    return found


def environment_light(
    captured: CapturedScene,
    place: BoundingSphere,
    *,
    map_from_capture: Float[Tensor, "3 3"],
    height: int,
    given: Light | None = None,
    sun_through: Sequence[Point] = (),
) -> EnvironmentLight | NoLight:
    """Find the light at a place with its environment map.

    Args:
        captured: The scene without the object.
        place: The object's bounding sphere; Gaussians nearer to its middle than half its radius are left out.
        map_from_capture: Rotation from the scene's axes to those of the map.
        height: Rows of the map.
        given: A light that replaces the estimate; its ambient light is then the map.
        sun_through: As for `estimate_light`.

    Returns:
        The light, or the reason why there is none.
    """
    directions = equirectangular_directions(height) @ map_from_capture
    if given is not None:
        radiance = given.ambient_radiance(directions.reshape(-1, 3)).reshape(directions.shape)
        return EnvironmentLight(given, radiance, map_from_capture)
    found = estimate_light(captured, place, sun_through=sun_through)
    if isinstance(found, NoLight):
        return found
    return EnvironmentLight(found.light, _radiance(found, captured, place, directions), map_from_capture)


def place_at(center: Sequence[float], cameras: Cameras, radius: float | None) -> BoundingSphere:
    """Return a place without an object; its radius is an eighth of the cameras' median distance if not given."""
    middle = torch.as_tensor(center, dtype=torch.float32)
    return BoundingSphere(middle, radius or _RADIUS * float((cameras.centers - middle).norm(dim=1).median()))


def upright_from_capture(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Compute the rotation from a capture's axes to those in which Blender shows the exported .glb, +z up.

    Args:
        up: Unit, in the axes of the capture.
    """
    return _BLENDER_FROM_DOWN_Y @ rotation_between(up, -torch.eye(3)[1])


def equirectangular_directions(height: int) -> Float[Tensor, "h w 3"]:
    """Return the unit directions of an environment map's pixels in the layout of Blender's world.

    The map is twice as wide as high. Its top row looks along +z, its middle column along +x, and columns to the right
    turn towards -y, seen from inside.
    """
    polar = math.pi * (torch.arange(height) + 0.5)[:, None] / height
    azimuth = 2 * math.pi * (0.5 - (torch.arange(2 * height) + 0.5) / (2 * height))[None]
    return torch.stack([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos() + 0 * azimuth], -1)


def _radiance(
    found: EstimatedLight, captured: CapturedScene, place: BoundingSphere, directions: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w 3"]:
    """Compute the environment map without the estimate's sources, for unit directions in the frame of the scene."""
    height, width, _ = directions.shape
    flat, face = directions.reshape(-1, 3), max(height, 1)
    cube = render_panorama(captured.usable.gaussians, place.center, size=face, nearest=NEAREST * place.radius)
    shown = cube.radiance.reshape(-1, 3)[cube_pixels(flat, face)]
    around, rest = found.evidence.around, found.rest()
    # photographed sources are limited to the radiance around them
    is_cut = (rest < around.radiance).any(1, keepdim=True)
    limit = torch.where(is_cut, rest, math.inf)[nearest_directions(flat)]
    hidden = (rest - around.radiance).clamp_min(0)
    smooth = _interpolated(torch.cat([around.seen[:, None], hidden], 1), flat)
    radiance = torch.minimum(smooth[:, :1] * shown, limit) + smooth[:, 1:]
    return radiance.reshape(height, width, 3)


def _interpolated(values: Float[Tensor, "k c"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
    """Interpolate `values` of all `DIRECTIONS` smoothly."""
    parts = []
    for part in directions.split(_CHUNK):
        weights = ((part @ DIRECTIONS.T - 1) / _SMOOTH_RAD**2).exp()
        parts.append(weights @ values / weights.sum(1, keepdim=True))
    return torch.cat(parts)
