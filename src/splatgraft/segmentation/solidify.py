"""Fit of an extracted object, alone, to its masked photographs over random backgrounds.

An object that is half transparent or larger than its outline can look right in front of its own surroundings, because
both were fitted together. Only an opaque object inside its mask matches the photographs over every background. All
pixels and Gaussians of this fit belong to the object, so a draft of the capture is enough (docs/results.md).

1. Each view is cropped to the object. Pixels in which something else hides the object are not compared.
2. The object is fitted. If it has few Gaussians for its size in the photographs, Gaussians are split as in a
   reconstruction.
3. Gaussians that lie inside too few masks are removed.
4. Gaussians that hardly show in any view take the mean colour of their neighbours.

All constants are set by hand.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.fitting.density import DensityControl
from splatgraft.fitting.gaussian_fit import FitOptions, LearningRates, View, fit
from splatgraft.fitting.surface_loss import SurfaceLoss
from splatgraft.rendering import RenderOptions, render, view_operator
from splatgraft.runtime.progress import Progress, silent
from splatgraft.segmentation.selection import SelectOptions

_DENSIFICATIONS = 20  # number of densifications
_FULL_AT, _STOP_AT = 0.6, 0.7  # shares of the steps at which the number is reached, and after which density is fixed
_STRIDE = 2  # distance of the fitted pixels along each axis
_HIDDEN = 0.1  # visible pixels over a Gaussian's own area, relative to the median, below which its colour is unknown
_NEIGHBOURS = 8  # Gaussians of known colour whose mean replaces an unknown one
_RATES = LearningRates(
    means=1.6e-3,
    means_final=1.6e-5,
    log_scales=0.04,
    quaternions=0.008,
    opacity_logits=0.1,
    sh=0.02,
    sh_higher=0.001,
    view_colors=0.003,
    final=0.1,
)
"""Learning rates; those of the centres are over the object's radius."""
_OCCLUDER_DISTANCE = 0.25  # smallest distance of an occluder in front of the object, over the object's extent
_MARGIN_PX = 12  # margin of a cropped view around the object


@dataclass(frozen=True)
class SolidifyOptions:
    """Length and detail of the fit."""

    iterations: int = 1600
    """Number of steps, one view each."""
    pixels_per_gaussian: float = 3.0
    """Pixels of the object in the median view per Gaussian after splitting; 0 splits none."""
    budget: int = 50_000
    """Largest number of Gaussians after splitting."""
    threshold: float = SelectOptions.threshold
    """Minimum share of the masks that contain a Gaussian; others are removed after the fit."""
    view_gains: Sequence[float] | None = None
    """Brightness of each photo over their mean if exposure or white balance differ; colour maps of the photos are then
    fitted and stay out of the object. None fits no maps."""
    seed: int = 0
    """Seed of the order of views and of the backgrounds."""


@dataclass(frozen=True)
class _ObjectViews:
    """Views cropped to the object; a step fits every second pixel of one."""

    views: Sequence[View]

    def __len__(self) -> int:
        return len(self.views)

    def at(self, index: int, *, visit: int, done: float) -> View:
        return self.views[index].every_nth(_STRIDE, visit=visit, index=index)


def solidify_object(
    scene: Gaussians,
    selection: Bool[Tensor, "n"],
    cameras: Cameras,
    photographs: Sequence[tuple[Float[Tensor, "_ _ 3"], Float[Tensor, "_ _"]]],
    *,
    options: SolidifyOptions = SolidifyOptions(),
    progress: Progress = silent,
) -> Gaussians:
    """Fit an extracted object alone to its masked images over random backgrounds, to make it opaque and detailed.

    Pixels outside the mask in which something in front hides the object are not compared.

    Args:
        scene: n Gaussians of the whole scene.
        selection: True for the object's Gaussians.
        cameras: v cameras, on the device of `scene`.
        photographs: The image (h, w, 3), sRGB in [0, 1], and the object mask (h, w) of each camera.
        options: Steps, detail and seed.
        progress: Called with steps done, steps in all and a short text.

    Returns:
        The object's Gaussians, changed in every field; densified where the images hold more detail than the Gaussians.

    Raises:
        ValueError: No mask shows the object.
    """
    chosen = scene.select(selection)
    views, gains, used = [], [], []
    for index, (camera, (image, mask)) in enumerate(zip(cameras, photographs, strict=True)):
        if (view := _cropped_view(scene, selection, camera, image, mask)) is not None:
            views.append(view)
            used.append(index)
            gains.append(1.0 if options.view_gains is None else options.view_gains[index])
    if not views:
        raise ValueError("object: expected a mask with some of it inside, found all empty")
    radius = float((chosen.means - chosen.means.mean(0)).norm(dim=1).quantile(0.9))
    away = float((cameras.centers - chosen.means.mean(0)).norm(dim=1).median())
    rates = replace(
        _RATES,
        means=radius * _RATES.means,
        means_final=radius * _RATES.means_final,
        view_colors=0.0 if options.view_gains is None else _RATES.view_colors,
    )
    fitted = fit(
        chosen,
        _ObjectViews(views),
        FitOptions(
            options.iterations,
            rates,
            background=None,
            view_gains=gains,
            surfaces=SurfaceLoss(unit=away),
            seed=options.seed,
        ),
        control=None if options.pixels_per_gaussian == 0 else _density(chosen, views, cameras, options).update,
        progress=lambda done, total, text: progress(done, total, f"making the object solid, {text}"),
    )
    share = _share_of_masks(fitted, cameras[torch.tensor(used)], views)
    return _with_known_colors(fitted.select(share >= options.threshold), views)


def _share_of_masks(gaussians: Gaussians, cameras: Cameras, views: Sequence[View]) -> Float[Tensor, "n"]:
    """Compute the share of masks that contain each centre, of those that frame it and in which nothing hides it.

    A few wrong masks that contain the same part of the background would leave it on the object as a strand.

    Args:
        gaussians: n Gaussians.
        cameras: Cameras of the whole photographs.
        views: The same photographs, cropped; their masks are empty outside.
    """
    inside, outside = torch.zeros(2, gaussians.count, device=gaussians.device)
    for camera, view in zip(cameras, views, strict=True):
        assert view.mask is not None
        pixels, depth = camera.project(gaussians.means)
        is_framed = (depth > 0) & (pixels >= 0).all(1) & (pixels < camera.sizes[0]).all(1)
        corner = camera.intrinsics[0, :2, 2] - view.camera.intrinsics[0, :2, 2]
        column, row = (pixels - corner).nan_to_num(-1).clamp(-1, 1e6).floor().long().unbind(1)
        height, width = view.mask.shape[:2]
        is_cropped = (column < 0) | (column >= width) | (row < 0) | (row >= height)
        at = row.clamp(0, height - 1), column.clamp(0, width - 1)
        is_inside = ~is_cropped & (view.mask[..., 0][at] > 127)
        is_hidden = torch.zeros_like(is_framed) if view.is_compared is None else ~view.is_compared[..., 0][at]
        inside += is_framed & is_inside
        outside += is_framed & ~is_inside & (is_cropped | ~is_hidden)
    return torch.where(inside + outside > 0, inside / (inside + outside).clamp_min(1), 1.0)


def _density(chosen: Gaussians, views: Sequence[View], cameras: Cameras, options: SolidifyOptions) -> DensityControl:
    """Make a density control whose budget follows from the object's size in the median view."""
    pixels = torch.tensor([float((view.mask > 127).sum()) for view in views if view.mask is not None])
    wanted = min(int(float(pixels.median()) / options.pixels_per_gaussian), options.budget)
    return DensityControl(
        budget=max(wanted, chosen.count),
        first_count=chosen.count,
        every=max(1, options.iterations // _DENSIFICATIONS),
        full_at=int(_FULL_AT * options.iterations),
        stop=int(_STOP_AT * options.iterations),
        camera_centers=cameras.centers,
    )


def _with_known_colors(gaussians: Gaussians, views: Sequence[View]) -> Gaussians:
    """Replace the colours of Gaussians that hardly show in any view by the mean of the nearest visible ones, band 0."""
    shown = torch.zeros(gaussians.count, device=gaussians.device)
    for view in views:
        ones = torch.ones_like(view.image[..., :1], dtype=torch.float32)
        shown += view_operator(gaussians, view.camera, RenderOptions()).blend_transpose(ones)[:, 0]
    widths = gaussians.scales.sort(1, descending=True).values[:, :2]
    known = shown / (widths.prod(1) * gaussians.opacities).clamp_min(1e-20)
    hidden = known < _HIDDEN * known.median()
    count = gaussians.count - int(hidden.sum())
    if count == gaussians.count or count <= _NEIGHBOURS:
        return gaussians
    tree = KDTree(gaussians.means[~hidden].cpu().numpy())
    _, nearest = tree.query(gaussians.means[hidden].cpu().numpy(), k=_NEIGHBOURS)
    sh = gaussians.sh.clone()
    sh[hidden] = 0
    sh[hidden, 0] = gaussians.sh[~hidden, 0][torch.from_numpy(nearest).to(sh.device)].mean(1)
    return replace(gaussians, sh=sh)


def _cropped_view(
    scene: Gaussians,
    selection: Bool[Tensor, "n"],
    camera: Cameras,
    image: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"],
) -> View | None:
    """Crop a view to the object; None if the mask is empty."""
    chosen = scene.select(selection)
    object_alone = render(chosen, camera, outputs=frozenset({"depth"}))
    rest = render(scene.select(~selection), camera, outputs=frozenset({"depth"}))
    extent = float((chosen.means.quantile(0.95, dim=0) - chosen.means.quantile(0.05, dim=0)).norm())
    in_front = rest.depth[0] < object_alone.depth[0] - _OCCLUDER_DISTANCE * extent
    occluded = in_front & (rest.alpha[0] > 0.5)
    hidden = occluded & (object_alone.alpha[0] > 0.5) & (mask.to(occluded.device) < 0.5)
    shown = (mask > 0.5) | ((object_alone.alpha[0] > 0.05) & ~hidden).to(mask.device)
    if not bool((mask > 0.5).any()):
        return None
    rows, columns = torch.nonzero(shown.any(1))[:, 0], torch.nonzero(shown.any(0))[:, 0]
    top, left = max(int(rows[0]) - _MARGIN_PX, 0), max(int(columns[0]) - _MARGIN_PX, 0)
    bottom = min(int(rows[-1]) + 1 + _MARGIN_PX, image.shape[0])
    right = min(int(columns[-1]) + 1 + _MARGIN_PX, image.shape[1])
    window = slice(top, bottom), slice(left, right)

    def cut(picture: Tensor) -> UInt8[Tensor, "h w c"]:
        return (picture[window].clamp(0, 1) * 255).round().to(scene.device, torch.uint8)

    return View(
        camera=camera.cropped([(left, top, right, bottom)]),
        image=cut(image),
        mask=cut(mask[..., None]),
        is_compared=~hidden[window][..., None],
    )
