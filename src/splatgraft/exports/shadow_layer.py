"""The shadow of a transfer as black Gaussians, to be drawn over another picture of the place.

Over-compositing black with opacity a multiplies the picture behind it by 1 - a. So the Gaussians of the place on which
the shadow falls are coloured black. Their opacities are fitted to the shadow in the target's cameras (least squares,
Adam). Light that the object adds to the place is left out.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, empty
from splatgraft.core.spherical_harmonics import dc_from_rgb
from splatgraft.exports.export_source import ExportSource
from splatgraft.rendering import render, view_operator
from splatgraft.runtime.progress import Progress, silent

# set by hand, on the demo's scenes
_VIEWS = 24  # cameras of the target; every fourth one is left out of the fit and measured
_LONGEST_PX = 320  # longer side of the pictures
_STEPS = 240  # steps of Adam, one view each
_STRIDE = 7  # smallest distance, in views, between two steps
_LEARNING_RATE = 0.15  # step size for opacity logits; it falls to a tenth
_MIN_GROUND = 0.02  # sRGB below which the share of missing light counts as 0
_MIN_SHARE = 0.01  # share of light that a Gaussian must miss to be part of the layer
_MIN_WEIGHT_PX = 0.5  # pixels that a Gaussian must make up in all views together
_MIN_OPACITY = 1 / 255  # opacity below which a Gaussian is left out at the end


@dataclass(frozen=True)
class ShadowLayer:
    """Black Gaussians and the quality of their fit."""

    gaussians: Gaussians
    """Black Gaussians in the frame of the scene; empty without a shadow."""
    psnr: float | None
    """PSNR of the place under the layer against the scene with the shadow, in views outside the fit, dB."""


@dataclass(frozen=True)
class _View:
    """Pictures of one view to which the layer is fitted."""

    camera: Cameras
    place: Float[Tensor, "h w 3"]
    shadowed: Float[Tensor, "h w 3"]
    darkness: Float[Tensor, "h w"]


def shadow_layer(source: ExportSource, *, progress: Progress = silent) -> ShadowLayer:
    """Fit the layer to the relit scene without its object, against the place.

    Raises:
        ValueError: The scene's object, the place or the cameras are not known.
    """
    if source.is_object is None or source.place is None or source.cameras is None:
        raise ValueError(
            f"--layer shadow: expected a project with its target's scene and cameras, found {source.title} without"
        )
    ground = source.scene.select(~source.is_object)
    cameras = source.cameras.spread(_VIEWS)
    views = [_view(camera.limited(_LONGEST_PX), ground, source.place) for camera in cameras]
    fitted = [view for index, view in enumerate(views) if index % 4 != 3] or views
    held_out = [view for index, view in enumerate(views) if index % 4 == 3] or views
    receivers = _receivers(ground, fitted)
    if receivers.count == 0:
        return ShadowLayer(empty(), None)
    layer = _fitted(receivers, fitted, progress)
    return ShadowLayer(layer, _psnr(layer, held_out))


def _view(camera: Cameras, ground: Gaussians, place: Gaussians) -> _View:
    """Draw a view and compute the share of light, in sRGB, that the shadow takes."""
    shadowed, before = (render(scene, camera).color[0].clamp(0, 1) for scene in (ground, place))
    level = before.mean(-1)
    darkness = (1 - shadowed.mean(-1) / level.clamp_min(_MIN_GROUND)).clamp(0, 1)
    return _View(camera, before, shadowed, torch.where(level < _MIN_GROUND, 0.0, darkness))


def _receivers(ground: Gaussians, views: list[_View]) -> Gaussians:
    """Find the Gaussians on which the shadow falls; each is black, its opacity the share of light that it misses."""
    missing, seen = torch.zeros(ground.count), torch.zeros(ground.count)
    for view in views:
        operator = view_operator(ground, view.camera)
        both = torch.stack([view.darkness, torch.ones_like(view.darkness)], -1)
        columns = operator.blend_transpose(both)
        missing, seen = missing + columns[:, 0], seen + columns[:, 1]
    share = missing / seen.clamp_min(1e-6)
    kept = (share > _MIN_SHARE) & (seen > _MIN_WEIGHT_PX)
    chosen = ground.select(kept)
    opacity = (share[kept] * chosen.opacities).clamp(0.002, 0.98)
    return replace(chosen, opacity_logits=opacity.logit(), sh=dc_from_rgb(torch.zeros(chosen.count, 1, 3)))


def _fitted(layer: Gaussians, views: list[_View], progress: Progress) -> Gaussians:
    logits = layer.opacity_logits.clone().requires_grad_()
    optimizer = torch.optim.Adam([logits], lr=_LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.1 ** (1 / _STEPS))
    for step, index in enumerate(_view_order(len(views))):
        view = views[index]
        alpha = render(replace(layer, opacity_logits=logits), view.camera).alpha[0]
        # weighted by the picture behind, because the layer multiplies it
        loss = ((alpha - view.darkness) * view.place.mean(-1)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        progress(step + 1, _STEPS, "fitting the shadow")
    done = replace(layer, opacity_logits=logits.detach())
    return done.select(done.opacities > _MIN_OPACITY)


def _view_order(count: int) -> Iterator[int]:
    """Visit all views in turn, in steps of the smallest stride that has no common factor with their number."""
    stride = next(n for n in range(_STRIDE, _STRIDE + count + 1) if math.gcd(n, count) == 1)
    return (step * stride % count for step in range(_STEPS))


def _psnr(layer: Gaussians, views: list[_View]) -> float:
    errors = []
    for view in views:
        alpha = render(layer, view.camera).alpha[0][..., None]
        errors.append((view.place * (1 - alpha) - view.shadowed).square().mean())
    return float(-10 * torch.log10(torch.stack(errors).mean().clamp_min(1e-10)))
