"""A placed object held by the pointer: moved along the surface under it, turned, scaled or lifted, in one view."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.editor.placement import PlaceableObject, rescale

GrabMode = Literal["move", "turn", "size", "lift"]
Point2 = tuple[float, float]
"""x and y on a canvas, over its width and height."""

_TURN = 2 * math.pi
"""Angle of a drag over the whole width, radians."""
_GROWTH = 2.0
"""Logarithm of the scale after a drag over the whole width."""
_WINDOW = 3
"""Half the side of the window of depths around a point, pixels."""
_FLOOR = 0.8
"""Cosine between up and the normal of a surface, above which an object can stand on it."""
_HULL_POINTS = 400
"""Points of an object that its outline is made of."""
_MIN_SIN = 0.05
"""Sine of the angle between a ray and the horizontal, below which they do not meet."""


@dataclass(frozen=True, eq=False)
class Grab:
    """An object as it was when it was grabbed, and the view in which it is dragged."""

    item: PlaceableObject
    """The object, in the frame of its own capture."""
    placed: Similarity
    """Its placement at the start."""
    camera: Cameras
    """The view, one camera."""
    depth: Float[np.ndarray, "h w"]
    """Depth of the scene without it in that view, world units; infinite where nothing is."""
    up: Float[Tensor, "3"]
    """Unit up direction of the target."""
    mode: GrabMode
    start: Point2
    """Where the pointer grabbed it."""

    def at(self, pointer: Point2) -> Similarity:
        """The placement with the pointer at another point."""
        dx, dy = pointer[0] - self.start[0], pointer[1] - self.start[1]
        if self.mode == "turn":
            return self._turned(_TURN * dx)
        if self.mode == "size":
            return rescale(self.item, self.placed, self.placed.scale * math.exp(_GROWTH * (dx - dy)))
        foot = self.placed.points(self.item.base.point)
        moved = self._lifted(foot, dy) if self.mode == "lift" else self._on_surface(foot, dx, dy)
        return replace(self.placed, translation=self.placed.translation + (moved - foot))

    def _turned(self, angle: float) -> Similarity:
        half = torch.tensor([math.cos(angle / 2)]), math.sin(angle / 2) * self.up
        turn = rotation_from_quaternion(torch.cat(half)[None])[0]
        foot = self.placed.points(self.item.base.point)
        about = Similarity(1.0, turn, foot - turn @ foot)
        return about @ self.placed

    def _lifted(self, foot: Float[Tensor, "3"], dy: float) -> Float[Tensor, "3"]:
        """The foot above or below where it was, so that it follows the pointer."""
        local, up = self._local(foot), self.camera.camera_from_world[0, :3, :3] @ self.up
        # pixels down the image for one unit upwards
        rate = float(self.camera.intrinsics[0, 1, 1] * (up[1] * local[2] - local[1] * up[2]) / local[2] ** 2)
        if abs(rate) < 1e-6:
            return foot
        return foot + dy * self.camera.height / rate * self.up

    def _on_surface(self, foot: Float[Tensor, "3"], dx: float, dy: float) -> Float[Tensor, "3"]:
        """The foot under the pointer: on a surface that an object can stand on, else at its height before the drag."""
        local = self.camera.intrinsics[0] @ self._local(foot)
        if float(local[2]) <= 0:
            return foot
        u, v = (local[:2] / local[2]).tolist()
        u, v = u + dx * self.camera.width, v + dy * self.camera.height
        # a foot behind the canvas's edge stays at it
        u, v = min(max(u, 0.0), self.camera.width - 1.0), min(max(v, 0.0), self.camera.height - 1.0)
        found = self._floor_at(u, v)
        if found is not None:
            return found
        origin, direction = self.camera.centers[0], self._rays(torch.tensor([[u, v]]))[0]
        fall = float(direction @ self.up)
        distance = float((foot - origin) @ self.up) / fall if abs(fall) > _MIN_SIN else -1.0
        return origin + distance * direction if distance > 0 else foot

    def _floor_at(self, u: float, v: float) -> Float[Tensor, "3"] | None:
        """The point of the surface at a pixel; None where there is none, or it is steep or broken."""
        height, width = self.depth.shape
        reach = max(1, width // 300)
        rows = np.clip(round(v) + reach * np.arange(-_WINDOW, _WINDOW + 1), 0, height - 1)
        columns = np.clip(round(u) + reach * np.arange(-_WINDOW, _WINDOW + 1), 0, width - 1)
        depths = self.depth[np.ix_(rows, columns)]
        if not np.isfinite(depths).all():
            return None
        y, x = np.meshgrid(rows, columns, indexing="ij")
        rays = self._rays(torch.from_numpy(np.stack([x.ravel(), y.ravel()], 1)).float())
        points = self.camera.centers[0] + torch.from_numpy(depths.reshape(-1, 1)).float() * rays
        offset = points - points.mean(0)
        normal = torch.linalg.svd(offset, full_matrices=False).Vh[2]
        if abs(float(normal @ self.up)) < _FLOOR:
            return None
        return self.camera.centers[0] + float(np.median(depths)) * self._rays(torch.tensor([[u, v]]))[0]

    def _local(self, point: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
        pose = self.camera.camera_from_world[0]
        return pose[:3, :3] @ point + pose[:3, 3]

    def _rays(self, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        """The rays through pixels, of depth 1."""
        k = self.camera.intrinsics[0]
        local = (pixels - k[:2, 2]) / torch.stack([k[0, 0], k[1, 1]])
        return torch.cat([local, torch.ones(len(local), 1)], 1) @ self.camera.world_from_camera[0, :3, :3].T


def outline(points: Float[Tensor, "n 3"], camera: Cameras) -> list[Point2]:
    """The convex outline of points in a view, on its canvas; empty where they are behind the camera."""
    pixels, depth = camera.project(points[:: max(1, len(points) // _HULL_POINTS)])
    pixels = pixels[depth > 0]
    if len(pixels) < 3:
        return []
    hull = cv2.convexHull(pixels.numpy().astype(np.float32))[:, 0]
    return [(round(float(x) / camera.width, 4), round(float(y) / camera.height, 4)) for x, y in hull]
