"""A placed object held by the pointer: moved along its support, turned, scaled or lifted, in one view.

The placement at each moment of a drag is the placement after it. A moved object keeps its turn and stops where its foot
would leave the support.
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
from splatgraft.editor.placement import PlaceableObject, rescale
from splatgraft.rendering import render

DragMode = Literal["move", "turn", "size", "lift"]
Point2 = tuple[float, float]
"""x and y on a canvas, over its width and height."""

_TURN = 2 * math.pi  # angle of a drag over the whole width, radians
_GROWTH = 2.0  # logarithm of the scale after a drag over the whole width
_DEPTH_WIDTH = 320  # pixels; the picture of depths by which the pointer finds the support
_FLAT = 0.6  # share of the foot's disc that must lie on the support, as for a duplicate
_ALIKE = 0.85  # of the share where the drag began: an object on rough ground can be moved along it
_STEP = 0.5  # largest change of height in a drag over the object's height, unless another support is wanted
_NEAR = 0.5  # height above the support over the object's within which an object stands on it
_STRAIGHT = math.cos(math.radians(10.0))  # an object that is tilted more against its support keeps its tilt
_EVEN = math.cos(math.radians(1.5))  # an object follows larger tilts of its support; every turn makes drafts slow
_NEAR_RADII = 10  # half the side of the box of Gaussians among which supports are searched, over the foot's radius
_HALVINGS = 5  # of the way to a place where the object cannot stand: 3% of it
_HULL_POINTS = 400  # points of an object that its outline is made of
_MIN_SIN = 0.05  # sine of the angle between a ray and the horizontal, below which they do not meet


class Drag:
    """An object as it was when it was grabbed, and the view in which it is dragged."""

    def __init__(
        self, item: PlaceableObject, placed: Similarity, camera: Cameras, place: Gaussians, *, up: Tensor
    ) -> None:
        """Grab an object at its placement; `place` is the scene without it."""
        self.item, self.placed, self._up = item, placed, torch.nn.functional.normalize(up, dim=0)
        # colours do not matter for a surface
        self._place = place.with_sh_degree(0)
        self._camera = camera.resized(_DEPTH_WIDTH / camera.width)
        found = render(self._place, self._camera, outputs=frozenset({"depth"}))
        self._depth = torch.where(found.alpha[0] > 0.5, found.depth[0], 0.0)
        self._foot = placed.points(item.base.point)
        self._last = self._foot
        self._near: tuple[Tensor, Gaussians] | None = None
        support = self._support(self._foot)
        above = math.inf if support is None else float((self._foot - support.point) @ self._up)
        self._stands = abs(above) < _NEAR * placed.scale * item.base.height
        self._flat = 0.0 if support is None else min(_FLAT, _ALIKE * support.flat_fraction)
        straight = support is not None and float(placed.rotation @ item.base.up @ support.normal) > _STRAIGHT
        self._is_straight = straight
        self._best = placed

    def at(self, mode: DragMode, start: Point2, pointer: Point2, *, anywhere: bool = False) -> Similarity:
        """The placement with the pointer elsewhere than where it grabbed; `anywhere`: on another support, too."""
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
        """The placement nearest to a wanted foot at which the object stands, on the way from where it stood last."""
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
        """The object at rest on the support at a foot; None where it cannot stand there."""
        support = self._support(foot)
        if support is None or support.flat_fraction < self._flat:
            return None
        height = self.placed.scale * self.item.base.height
        if not anywhere and abs(float((support.point - self._foot) @ self._up)) > _STEP * height:
            return None
        rotation = self._best.rotation
        if self._is_straight and float(rotation @ self.item.base.up @ support.normal) < _EVEN:
            rotation = (rotation_between(rotation @ self.item.base.up, support.normal) @ rotation).float()
        translation = support.point - self.placed.scale * rotation @ self.item.base.point
        return Similarity(scale=self.placed.scale, rotation=rotation, translation=translation.float())

    def _support(self, foot: Float[Tensor, "3"]) -> Support | None:
        radius, height = self.placed.scale * self.item.base.radius, self.placed.scale * self.item.base.height
        # only what lies around matters, and drawing it is fast
        if self._near is None or float((self._near[0] - foot).abs().max()) > 2 * radius:
            near = (self._place.means - foot).abs().amax(1) < _NEAR_RADII * radius + height
            self._near = foot, self._place.select(near)
        try:
            return support_below(self._near[1], foot + 0.5 * height * self._up, up=self._up, radius=radius)
        except ValueError:
            return None  # nothing lies below

    def _pointed_at(self, dx: float, dy: float, *, anywhere: bool) -> Float[Tensor, "3"]:
        """The foot under the pointer: on the surface there, or at its own height where that is another surface."""
        u, v = self._pixel(dx, dy)
        ray, origin = self._ray(u, v), self._camera.centers[0]
        depth = float(self._depth[int(v), int(u)])
        if depth > 0 and self._stands:
            hit = origin + depth * ray
            if (
                anywhere
                or abs(float((hit - self._foot) @ self._up)) < _STEP * self.placed.scale * self.item.base.height
            ):
                return hit
        fall = float(ray @ self._up)
        distance = float((self._last - origin) @ self._up) / fall if abs(fall) > _MIN_SIN else -1.0
        return origin + distance * ray if distance > 0 else self._last

    def _pixel(self, dx: float, dy: float) -> Point2:
        pixels, depth = self._camera.project(self._foot)
        u, v = pixels.tolist() if float(depth) > 0 else (0.5 * self._camera.width, 0.5 * self._camera.height)
        u, v = u + dx * self._camera.width, v + dy * self._camera.height
        return min(max(u, 0.0), self._camera.width - 1.0), min(max(v, 0.0), self._camera.height - 1.0)

    def _ray(self, u: float, v: float) -> Float[Tensor, "3"]:
        """The ray through a pixel, of depth 1."""
        k = self._camera.intrinsics[0]
        local = torch.tensor([(u - float(k[0, 2])) / float(k[0, 0]), (v - float(k[1, 2])) / float(k[1, 1]), 1.0])
        return self._camera.world_from_camera[0, :3, :3] @ local

    # up and down

    def _lifted(self, dy: float) -> Float[Tensor, "3"]:
        """The foot above or below where it was, so that it follows the pointer."""
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
    """A point in the scene that the pointer drags at its depth in a view, such as the corner of a box."""

    point: Float[Tensor, "3"]
    camera: Cameras

    def at(self, pointer: Point2) -> Float[Tensor, "3"]:
        """The point under the pointer."""
        depth = self.camera.project(self.point)[1]
        k, pose = self.camera.intrinsics[0], self.camera.world_from_camera[0]
        pixel = torch.tensor([pointer[0] * self.camera.width, pointer[1] * self.camera.height, 1.0])
        return pose[:3, :3] @ (torch.linalg.inv(k) @ pixel * depth) + pose[:3, 3]


def outline(points: Float[Tensor, "n 3"], camera: Cameras) -> list[Point2]:
    """The convex outline of points in a view, on its canvas; empty where they are behind the camera."""
    pixels, depth = camera.project(points[:: max(1, len(points) // _HULL_POINTS)])
    pixels = pixels[depth > 0]
    if len(pixels) < 3:
        return []
    hull = cv2.convexHull(pixels.numpy().astype(np.float32))[:, 0]
    return [(round(float(x) / camera.width, 4), round(float(y) / camera.height, 4)) for x, y in hull]


def on_canvas(points: Float[Tensor, "n 3"], camera: Cameras) -> list[Point2 | None]:
    """Points in a view, on its canvas; None for those behind the camera."""
    pixels, depth = camera.project(points)
    size = (pixels / camera.sizes[0].to(pixels)).tolist()
    return [(round(x, 4), round(y, 4)) if far > 0 else None for (x, y), far in zip(size, depth.tolist(), strict=True)]
