"""Dragging of a placed object in one view: along its support, or to turn, scale or lift it.

The placement shown during a drag is the one that a release keeps. A moved object keeps its yaw and stops before its
foot leaves the support.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition import Support, support_below
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import rotation_about, rotation_between
from splatgraft.core.similarity import Similarity
from splatgraft.editor.picking import Ray
from splatgraft.editor.placement import PlaceableObject, rescale
from splatgraft.rendering import render

DragMode = Literal["move", "turn", "size", "lift"]
Point2 = tuple[float, float]
"""x and y as fractions of a canvas's width and height."""

_TURN = 2 * math.pi  # radians for a drag over the whole width
_GROWTH = 2.0  # log of the scale factor for a drag over the whole width
_DEPTH_WIDTH = 320  # pixels; width of the depth map that gives the surface under the pointer
_FLAT = 0.6  # share of the foot's disc that must lie on the support, as for a duplicate
_ALIKE = 0.85  # factor on the share at the start, which lowers `_FLAT` on rough ground
_STEP = 0.5  # largest height change in a drag over the object's height, unless `anywhere`
_NEAR = 0.5  # largest distance over the object's height at which an object rests on a support
_STRAIGHT = math.cos(math.radians(10.0))  # an object tilted more from its support keeps its tilt
_EVEN = math.cos(math.radians(1.5))  # smaller tilts of a support are ignored, because rotations slow drafts
_NEAR_RADII = 10  # half the side of the box in which a support is searched, over the foot's radius
_HALVINGS = 5  # bisection steps towards a place off the support; they resolve 3% of the way
_HULL_POINTS = 400  # points of an object from which its outline is computed
_MIN_SIN = 0.05  # sine of a ray's angle to the horizontal; flatter rays do not meet a level plane


class Drag:
    """A grabbed object with its initial placement, and the view in which it is dragged."""

    def __init__(
        self, item: PlaceableObject, placed: Similarity, camera: Cameras, place: Gaussians, *, up: Tensor
    ) -> None:
        """Grab an object at its placement; `place` is the rest of the scene."""
        self.item, self.placed, self._up = item, placed, torch.nn.functional.normalize(up, dim=0)
        # colours do not matter for a surface
        self._place = place.with_sh_degree(0)
        self._camera = camera.resized(_DEPTH_WIDTH / camera.width)
        found = render(self._place, self._camera, outputs=frozenset({"depth"}))
        self._depth = torch.where(found.alpha[0] > 0.5, found.depth[0], 0.0)
        self._foot = placed.points(item.base.point)
        self._height, self._radius = placed.scale * item.base.height, placed.scale * item.base.radius
        self._last = self._foot
        self._near: tuple[Tensor, Gaussians] | None = None
        support = self._support(self._foot)
        above = math.inf if support is None else float((self._foot - support.point) @ self._up)
        self._stands = abs(above) < _NEAR * self._height
        self._flat = 0.0 if support is None else min(_FLAT, _ALIKE * support.flat_fraction)
        tilt = 0.0 if support is None else float(placed.rotation @ item.base.up @ support.normal)
        self._is_straight = tilt > _STRAIGHT
        self._best = placed

    def at(self, mode: DragMode, start: Point2, pointer: Point2, *, anywhere: bool = False) -> Similarity:
        """Return the placement after a drag from `start` to `pointer`; `anywhere` permits another support."""
        dx, dy = pointer[0] - start[0], pointer[1] - start[1]
        if mode == "turn":
            turn = rotation_about(self._up, _TURN * dx).float()
            return Similarity(1.0, turn, self._foot - turn @ self._foot) @ self.placed
        if mode == "size":
            return rescale(self.item, self.placed, self.placed.scale * math.exp(_GROWTH * (dx - dy)))
        if mode == "lift":
            return self._shifted(self._lifted(dy))
        return self._slid(self._pointed_at(dx, dy, anywhere=anywhere), anywhere=anywhere)

    # along the support

    def _slid(self, wanted: Float[Tensor, "3"], *, anywhere: bool) -> Similarity:
        """Return the valid placement nearest to the wanted foot, on the line from the last valid one."""
        if not self._stands:
            return self._shifted(wanted)
        begin, share, step = self._last, 1.0, 0.5
        for number in range(_HALVINGS + 1):
            foot = begin + share * (wanted - begin)
            found = self._rested(foot, anywhere=anywhere and number == 0)
            if found is not None:
                self._best, self._last = found, found.points(self.item.base.point)
                if number == 0:
                    break
            share, step = (share + step if found is not None else share - step), step / 2
        return self._best

    def _rested(self, foot: Float[Tensor, "3"], *, anywhere: bool) -> Similarity | None:
        """Place the object on the support at a foot; return None if it cannot rest there."""
        support = self._support(foot)
        if support is None or support.flat_fraction < self._flat:
            return None
        if not anywhere and abs(self._above_foot(support.point)) > _STEP * self._height:
            return None
        rotation = self._best.rotation
        if self._is_straight and float(rotation @ self.item.base.up @ support.normal) < _EVEN:
            rotation = (rotation_between(rotation @ self.item.base.up, support.normal) @ rotation).float()
        translation = support.point - self.placed.scale * rotation @ self.item.base.point
        return Similarity(scale=self.placed.scale, rotation=rotation, translation=translation.float())

    def _support(self, foot: Float[Tensor, "3"]) -> Support | None:
        # a search among nearby Gaussians is fast
        if self._near is None or float((self._near[0] - foot).abs().max()) > 2 * self._radius:
            near = (self._place.means - foot).abs().amax(1) < _NEAR_RADII * self._radius + self._height
            self._near = foot, self._place.select(near)
        try:
            above = foot + 0.5 * self._height * self._up
            return support_below(self._near[1], above, up=self._up, radius=self._radius)
        except ValueError:
            return None  # no surface below

    def _pointed_at(self, dx: float, dy: float, *, anywhere: bool) -> Float[Tensor, "3"]:
        """Return the foot under the pointer: on the surface there, or at its last height if that surface is another."""
        width, height = self._camera.width, self._camera.height
        pixels, depth = self._camera.project(self._foot)
        u, v = pixels.tolist() if float(depth) > 0 else (0.5 * width, 0.5 * height)
        u, v = min(max(u + dx * width, 0.0), width - 1.0), min(max(v + dy * height, 0.0), height - 1.0)
        found = Ray.through((u / width, v / height), self._camera)
        ray, origin, depth = found.direction, found.origin, float(self._depth[int(v), int(u)])
        hit = origin + depth * ray
        if depth > 0 and self._stands and (anywhere or abs(self._above_foot(hit)) < _STEP * self._height):
            return hit
        fall = float(ray @ self._up)
        distance = float((self._last - origin) @ self._up) / fall if abs(fall) > _MIN_SIN else -1.0
        return origin + distance * ray if distance > 0 else self._last

    def _above_foot(self, point: Float[Tensor, "3"]) -> float:
        """Return the height of a point over the initial foot."""
        return float((point - self._foot) @ self._up)

    # up and down

    def _lifted(self, dy: float) -> Float[Tensor, "3"]:
        """Return the foot, moved vertically to follow the pointer."""
        pose = self._camera.camera_from_world[0]
        local, up = pose[:3, :3] @ self._foot + pose[:3, 3], pose[:3, :3] @ self._up
        # pixels down the image for one unit upwards
        rate = float(self._camera.intrinsics[0, 1, 1] * (up[1] * local[2] - local[1] * up[2]) / local[2] ** 2)
        if abs(rate) < 1e-6:
            return self._foot
        return self._foot + dy * self._camera.height / rate * self._up

    def _shifted(self, foot: Float[Tensor, "3"]) -> Similarity:
        return replace(self.placed, translation=self.placed.translation + (foot - self._foot))


@dataclass(frozen=True)
class Corner:
    """A scene point that is dragged at its depth in a view, such as the corner of a box."""

    point: Float[Tensor, "3"]
    camera: Cameras

    def at(self, pointer: Point2) -> Float[Tensor, "3"]:
        """Return the point under the pointer."""
        ray = Ray.through(pointer, self.camera)
        return ray.origin + self.camera.project(self.point)[1] * ray.direction


def outline(points: Float[Tensor, "n 3"], camera: Cameras) -> list[Point2]:
    """Compute the convex outline of points on a view's canvas; empty if they are behind the camera."""
    pixels, depth = camera.project(points[:: max(1, len(points) // _HULL_POINTS)])
    pixels = pixels[depth > 0]
    if len(pixels) < 3:
        return []
    hull = cv2.convexHull(pixels.numpy().astype(np.float32))[:, 0]
    return [(round(float(x) / camera.width, 4), round(float(y) / camera.height, 4)) for x, y in hull]


def on_canvas(points: Float[Tensor, "n 3"], camera: Cameras) -> list[Point2 | None]:
    """Project points onto a view's canvas; None for those behind the camera."""
    pixels, depth = camera.project(points)
    size = (pixels / camera.sizes[0].to(pixels)).tolist()
    return [(round(x, 4), round(y, 4)) if far > 0 else None for (x, y), far in zip(size, depth.tolist(), strict=True)]
