"""A window's camera, which turns around a point above the support and in front of walls."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.picking import first_surface_hit
from splatgraft.editor.relit_preview import largest_coverage_indices

Vector = Float[np.ndarray, "3"]
_STEEPEST = math.radians(88.0)  # angle of the line of sight to the horizontal; up is undefined at 90 degrees
_TURN = 2 * math.pi  # radians for a drag over the canvas's height
_NEAREST, _FARTHEST = 1e-3, 1e3  # distances to the pivot over the typical one of the scene
_CLEAR = 0.03  # height above the support over the typical distance
_BEFORE_WALL = 0.93  # fraction of the way to a wall at which a camera is placed that would be in or behind it
_FREE = 0.6  # surfaces nearer to the pivot are objects, not walls; over the typical distance
_SURFACES = 20_000  # number of Gaussians used as walls, those with the largest coverage
_FRAMED = 1.5  # distance over the one at which an object fills the height


@dataclass(frozen=True)
class Orbit:
    """A camera pose, and the point around which it turns."""

    world_from_camera: Float[np.ndarray, "4 4"]
    """Pose, OpenCV axes."""
    distance: float
    """Distance to the pivot along the optical axis, world units."""
    half_height: float
    """Tangent of half the vertical field of view."""
    aspect: float = 0.0
    """Width over height of a picture that must be fully visible; 0: none."""

    @property
    def position(self) -> Vector:
        """Camera position."""
        return self.world_from_camera[:3, 3]

    @property
    def forward(self) -> Vector:
        """Unit direction of the line of sight."""
        return self.world_from_camera[:3, 2]

    @property
    def pivot(self) -> Vector:
        """Point around which the view turns."""
        return self.position + self.distance * self.forward

    def camera(self, width: int, height: int) -> Cameras:
        """Return the camera of a canvas with the whole picture in its middle."""
        half = self.half_height * max(1.0, self.aspect * height / width if self.aspect else 1.0)
        pose = torch.tensor(self.world_from_camera, dtype=torch.float32)
        return pinhole(pose[None], height / (2 * half), width=width, height=height)

    def turned(self, dx: float, dy: float, *, up: Vector) -> "Orbit":
        """Turn around the pivot by a drag in units of the canvas's height."""
        level = math.asin(float(np.clip(self.forward @ up, -1, 1)))
        wanted = float(np.clip(level - 0.5 * _TURN * dy, -_STEEPEST, _STEEPEST))
        ahead = self.forward - (self.forward @ up) * up
        if np.linalg.norm(ahead) < 1e-6:
            ahead = -self.world_from_camera[:3, 1] + (self.world_from_camera[:3, 1] @ up) * up
        ahead = _unit(ahead)
        angle = -_TURN * dx
        ahead = math.cos(angle) * ahead + math.sin(angle) * np.cross(up, ahead)
        return self.looking(self.pivot, math.cos(wanted) * ahead + math.sin(wanted) * up, self.distance, up=up)

    def moved(self, dx: float, dy: float) -> "Orbit":
        """Move sideways by a drag in units of the canvas's height; the pivot's plane follows the pointer."""
        height, pose = 2 * self.half_height * self.distance, self.world_from_camera.copy()
        pose[:3, 3] -= height * (dx * pose[:3, 0] + dy * pose[:3, 1])
        return replace(self, world_from_camera=pose)

    def zoomed(self, factor: float, *, scale: float) -> "Orbit":
        """Change the distance to the pivot; `scale` is a typical distance of the scene."""
        distance = float(np.clip(self.distance * factor, _NEAREST * scale, _FARTHEST * scale))
        pose = self.world_from_camera.copy()
        pose[:3, 3] = self.pivot - distance * self.forward
        return replace(self, world_from_camera=pose, distance=distance)

    def framing(self, sphere: BoundingSphere, *, up: Vector) -> "Orbit":
        """Look at a sphere from the present position's side; it fills two thirds of the height."""
        center = sphere.center.double().numpy()
        distance = _FRAMED * sphere.radius / math.sin(math.atan(self.half_height))
        return self.looking(center, center - self.position, distance, up=up)

    def looking(self, pivot: Vector, direction: Vector, distance: float, *, up: Vector) -> "Orbit":
        """Return the view of a point along a direction."""
        forward = _unit(direction)
        right = np.cross(forward, up)
        if np.linalg.norm(right) < 1e-6:
            right = self.world_from_camera[:3, 0]
        right = _unit(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
        pose[:3, 3] = pivot - distance * forward
        return replace(self, world_from_camera=pose, distance=distance)


def through(camera: Cameras, distance: float) -> Orbit:
    """Return the view of a capture's camera, which shows the whole picture on a canvas of any shape."""
    half_height = camera.height / (2 * float(camera.intrinsics[0, 1, 1]))
    return Orbit(camera.world_from_camera[0].double().numpy(), distance, half_height, camera.width / camera.height)


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Permitted camera positions: above the support, and not in or behind a wall."""

    up: Vector
    """Unit up direction."""
    floor: float
    """Lowest height along `up`, world units."""
    walls: Gaussians
    """Gaussians of the place's surfaces, without objects."""
    scale: float
    """Typical distance of the scene, world units."""

    @staticmethod
    def of(scene: Gaussians, cameras: Cameras, up: Float[Tensor, "3"], foot: Float[Tensor, "3"] | None) -> "FreeSpace":
        """Return a scene's free space, down to the lowest photo or just above `foot`, whichever is lower."""
        heights = cameras.centers @ up
        floor, scale = float(heights.min()), typical_distance(cameras)
        if foot is not None:
            floor = min(floor, float(foot @ up) + _CLEAR * scale)
        walls = scene.select(largest_coverage_indices(scene, _SURFACES)).with_sh_degree(0)
        return FreeSpace(up.double().numpy(), floor, walls, scale)

    def kept(self, view: Orbit) -> Orbit:
        """Return the view, moved in front of walls and above the floor if necessary."""
        pivot, back = view.pivot, -view.forward
        distance = view.distance
        ray = torch.tensor(back).float()
        begin = pivot + _FREE * min(distance, self.scale) * back
        hit = first_surface_hit(self.walls, torch.tensor(begin).float(), ray)
        if hit is not None:
            way = float((hit.double().numpy() - pivot) @ back)
            if way < distance / _BEFORE_WALL:
                distance = _BEFORE_WALL * way
        place = pivot + distance * back
        short = self.floor - float(place @ self.up)
        if short <= 0:
            return view if distance == view.distance else view.looking(pivot, -back, distance, up=self.up)
        if float(pivot @ self.up) >= self.floor:
            # raised to the floor, still aimed at the pivot
            place = place + short * self.up
            return view.looking(pivot, pivot - place, float(np.linalg.norm(pivot - place)), up=self.up)
        pose = view.world_from_camera.copy()
        pose[:3, 3] = place + short * self.up
        return replace(view, world_from_camera=pose)


def typical_distance(cameras: Cameras) -> float:
    """Compute the median distance of camera centres from their mean, world units; positive."""
    return max(1e-6, float((cameras.centers - cameras.centers.mean(0)).norm(dim=1).median()))


def _unit(vector: Vector) -> Vector:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
