"""A scene with the cameras of its capture; normals and views are computed at first use and kept.

These are the only inputs of the light estimate that do not depend on the place.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.clock_sun import ClockSun
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.relighting.normals import Normals, estimate_normals
from splatgraft.rendering import Render, render

_NEAREST = 1e-6  # world units; minimum depth of a Gaussian that has a nearness
_HUGE = 1e6  # world units, and units of colour; larger Gaussians come from errors of formats or optimisers


@dataclass(frozen=True, eq=False)
class CapturedScene:
    """The n Gaussians of a scene and the cameras of its capture."""

    gaussians: Gaussians
    cameras: Cameras
    clock: ClockSun | None = None
    """The sun by the clock of the photos, if they have time and place."""

    @cached_property
    def up(self) -> Float[Tensor, "3"]:
        """Unit up direction, of `clock` if there is one, otherwise estimated from the cameras."""
        return estimate_up(self.cameras) if self.clock is None else torch.tensor(self.clock.up)

    @cached_property
    def usable(self) -> "CapturedScene":
        """The scene without Gaussians whose values are not finite or absurdly large."""
        good = _are_usable(self.gaussians)
        return self if bool(good.all()) else replace(self, gaussians=self.gaussians.select(good))

    @cached_property
    def normals(self) -> Normals:
        """Normals of all Gaussians, towards the cameras; unusable Gaussians have confidence 0."""
        if self.usable is self:
            return estimate_normals(self.gaussians, self.cameras, views=self.views)
        good, found = _are_usable(self.gaussians), self.usable.normals
        whole = Normals(
            vectors=torch.tensor([0.0, 0.0, 1.0]).repeat(len(good), 1),
            confidence=torch.zeros(len(good)),
            seen=torch.zeros(len(good), dtype=torch.bool),
        )
        whole.vectors[good], whole.confidence[good], whole.seen[good] = found.vectors, found.confidence, found.seen
        return whole

    @cached_property
    def views(self) -> tuple[tuple[Cameras, Render], ...]:
        """Single cameras, up to 16 spread over the list, with colour and depth of the scene at up to 480 pixels.

        The depth is the inverse of the mean nearness, so that distant Gaussians seen through a slightly transparent
        surface hardly change it.
        """
        return tuple((one, self._drawn(one)) for one in self.cameras.spread(16).limited(480))

    def _drawn(self, camera: Cameras) -> Render:
        pose = camera.camera_from_world[0]
        away = self.gaussians.means @ pose[2, :3] + pose[2, 3]
        nearness = torch.where(away > _NEAREST, 1 / away.clamp_min(_NEAREST), 0.0)
        drawn = render(self.gaussians, camera, features=nearness[:, None])
        depth = drawn.alpha / drawn.features[..., 0].clamp_min(1 / _HUGE)
        return replace(drawn, pictures={"color": drawn.color, "depth": depth})

    def with_object(self, thing: Gaussians) -> "CapturedScene":
        """Add the Gaussians of an object after those of the scene."""
        return replace(self, gaussians=concatenate([self.gaussians, thing]))


def _are_usable(gaussians: Gaussians) -> Bool[Tensor, "n"]:
    good = torch.ones(gaussians.count, dtype=torch.bool)
    for values in (gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.sh.flatten(1)):
        good &= (values.abs() < _HUGE).all(1)  # false for nan too
    return good
