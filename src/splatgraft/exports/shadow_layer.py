"""The shadow of a transfer as black Gaussians, to be drawn over another picture of the place.

Over-compositing black with opacity a multiplies what lies behind by 1 - a. The Gaussians of the place on which the
shadow falls are therefore coloured black, and their opacities fitted so that the pictures of the target's cameras get
as dark as the shadow makes them (least squares, Adam). Light that the object adds to the place is left out.
"""

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

_VIEWS = 24
"""Cameras of the target; every fourth one is left out of the fit and measured. All numbers are set by hand, on the
demo's scenes."""
_LONGEST_PX = 320  # longer side of the pictures
_STEPS = 240  # steps of Adam, one view each
_LEARNING_RATE = 0.15  # step size for opacity logits; it falls to a tenth
_MIN_GROUND = 0.02  # sRGB below which nothing is said about the share of light that is missing
_MIN_SHARE = 0.01  # share of light that a Gaussian must miss to be part of the layer
_MIN_WEIGHT_PX = 0.5  # pixels that a Gaussian must make up in all views together
_MIN_OPACITY = 1 / 255  # opacity below which a Gaussian is left out at the end


@dataclass(frozen=True)
class ShadowLayer:
    """Black Gaussians, and how well they do."""

    gaussians: Gaussians
    """In the frame of the scene; none where there is no shadow."""
    psnr: float | None
    """The place with the layer over it against the scene with the shadow, in views outside the fit, dB."""


@dataclass(frozen=True)
class _View:
    """What the layer is fitted to."""

    camera: Cameras
    place: Float[Tensor, "h w 3"]
    shadowed: Float[Tensor, "h w 3"]
    darkness: Float[Tensor, "h w"]


def shadow_layer(source: ExportSource, *, progress: Progress = silent) -> ShadowLayer:
    """Fit the layer to the relit scene without its object, against the place; ValueError where these are not known."""
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
    """A view and the share of light, in sRGB, that the shadow takes."""
    shadowed, before = (render(scene, camera).color[0].clamp(0, 1) for scene in (ground, place))
    level = before.mean(-1)
    darkness = (1 - shadowed.mean(-1) / level.clamp_min(_MIN_GROUND)).clamp(0, 1)
    return _View(camera, before, shadowed, torch.where(level < _MIN_GROUND, 0.0, darkness))


def _receivers(ground: Gaussians, views: list[_View]) -> Gaussians:
    """The Gaussians on which the shadow falls, black, with the share of light that each misses as opacity."""
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
    for step in range(_STEPS):
        view = views[step * 7 % len(views)]
        alpha = render(replace(layer, opacity_logits=logits), view.camera).alpha[0]
        # weighted by what lies behind, as that is what the layer changes
        loss = ((alpha - view.darkness) * view.place.mean(-1)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        progress(step + 1, _STEPS, "fitting the shadow")
    done = replace(layer, opacity_logits=logits.detach())
    return done.select(done.opacities > _MIN_OPACITY)


def _psnr(layer: Gaussians, views: list[_View]) -> float:
    errors = []
    for view in views:
        alpha = render(layer, view.camera).alpha[0][..., None]
        errors.append((view.place * (1 - alpha) - view.shadowed).square().mean())
    return float(-10 * torch.log10(torch.stack(errors).mean().clamp_min(1e-10)))
