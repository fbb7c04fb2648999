"""Makes an extracted object opaque and finer: fits it alone to its masked photographs over random backgrounds.

In its own capture an object may be half transparent, or stick out of its outline, and still look right before what was
fitted with it. Only an opaque object inside its mask matches the photographs over every background.

Where the object has fewer Gaussians than its size in the photographs asks for, those are split that have the largest
gradient (3DGS, Sec. 5). What no photograph shows gets the colours of what is next to it. All constants are set by hand.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.splitting import PIECES, split_along
from splatgraft.rendering import RenderOptions, render, view_operator
from splatgraft.runtime.progress import Progress, silent

_MAX_SHARE = 0.5
"""Most Gaussians that it is split to, over those of the scene, whose number was chosen for the machine and time."""
_DENSIFICATIONS = 8
"""How many times Gaussians are split, evenly spaced."""
_DENSIFIED = 0.6
"""Share of the steps after which none is split."""
_DEAD_OPACITY = 0.02
"""Opacity below which a Gaussian is removed when others are split."""
_HIDDEN = 0.1
"""Pixels in which a Gaussian shows, over the square of its width, below which its colour is not known; over the median
one."""
_NEIGHBOURS = 8
"""Gaussians of known colour whose mean is taken then."""
_OPACITY_RATE, _COLOR_RATE, _SCALE_RATE = 0.05, 0.0025, 0.005
"""Learning rates of Adam: logits, band 0 (a twentieth for the others, as 3DGS), and natural logarithms per step."""
_POSITION_RATE = 2e-4
"""Learning rate of Adam, per step, over the object's radius."""
_ROTATION_RATIO = 0.2
"""Learning rate of the quaternions over that of the scales."""
_OCCLUDER_DISTANCE = 0.25
"""Distance in front of the object, over its extent, from which something else occludes it."""
_MARGIN_PX = 12
"""Border of the image windows around the object."""


@dataclass(frozen=True)
class SolidifyOptions:
    """Length and detail of the fit."""

    iterations: int = 800
    """Steps, one view each."""
    pixels_per_gaussian: float = 6.0
    """Pixels of the object in the median view for each Gaussian that it should have; 0 splits none."""
    seed: int = 0
    """Seed of the views and backgrounds drawn."""


@dataclass(frozen=True)
class _CroppedView:
    """One view, cropped to the object."""

    camera: Cameras
    image: Float[Tensor, "h w 3"]
    mask: Float[Tensor, "h w 1"]
    weight: Float[Tensor, "h w 1"]


def solidify_object(
    scene: Gaussians,
    selection: Bool[Tensor, "n"],
    cameras: Cameras,
    photographs: Sequence[tuple[Float[Tensor, "_ _ 3"], Float[Tensor, "_ _"]]],
    *,
    options: SolidifyOptions = SolidifyOptions(),
    progress: Progress = silent,
) -> Gaussians:
    """Fit an extracted object alone to its masked images over random backgrounds, so that it becomes opaque and fine.

    Pixels outside the mask where the object is hidden by something in front of it are not used.

    Args:
        scene: n Gaussians of the whole scene.
        selection: Which of them are the object's.
        cameras: v cameras, on the device of `scene`.
        photographs: The image (h, w, 3), sRGB in [0, 1], and the object mask (h, w) of each camera.
        options: Steps and rates.
        progress: Called with steps done, steps in all and a short text.

    Returns:
        The object's Gaussians, changed in every field, and more of them where the photographs show it larger than they
        are many.
    """
    chosen = scene.select(selection)
    views = [
        view
        for camera, (image, mask) in zip(cameras, photographs, strict=True)
        if (view := _cropped_view(scene, selection, camera, image, mask)) is not None
    ]
    if not views:
        raise ValueError("object: expected a mask with some of it inside, found all empty")
    wanted = 0
    if options.pixels_per_gaussian > 0:
        pixels = torch.tensor([float(view.mask.sum()) for view in views])
        wanted = min(int(float(pixels.median()) / options.pixels_per_gaussian), int(_MAX_SHARE * scene.count))
    first, stop = chosen.count, _DENSIFIED * options.iterations
    every = max(1, int(stop / _DENSIFICATIONS))
    fit = _Fit(chosen)
    generator = torch.Generator().manual_seed(options.seed)
    for step in range(options.iterations):
        view = views[int(torch.randint(len(views), (1,), generator=generator))]
        loss = fit.step(view, torch.rand(3, generator=generator))
        if step % 20 == 0:
            progress(step, options.iterations, f"making the object solid, loss {loss:.4f}")
        if wanted > first and 0 < step <= stop and step % every == 0:
            allowed = int(first + (wanted - first) * step / stop)
            fit = _Fit(_with_splits(fit.gaussians, fit.scores, allowed))
    progress(options.iterations, options.iterations, "the object is solid")
    return _with_known_colors(fit.gaussians, views)


class _Fit:
    """Gaussians that are fitted, and their scores since the start."""

    def __init__(self, gaussians: Gaussians) -> None:
        radius = float((gaussians.means - gaussians.means.mean(0)).norm(dim=1).quantile(0.9))
        rates = {
            "means": _POSITION_RATE * radius,
            "log_scales": _SCALE_RATE,
            "quaternions": _ROTATION_RATIO * _SCALE_RATE,
            "opacity_logits": _OPACITY_RATE,
            "base": _COLOR_RATE,
            "higher": _COLOR_RATE / 20,
        }
        start = vars(gaussians) | {"base": gaussians.sh[:, :1], "higher": gaussians.sh[:, 1:]}
        self._leaves = {name: start[name].detach().clone().requires_grad_() for name in rates}
        groups = [{"params": [self._leaves[name]], "lr": rate} for name, rate in rates.items()]
        self._optimizer = torch.optim.Adam(groups, eps=1e-15)
        self.scores = torch.zeros(gaussians.count, device=gaussians.device)
        """Summed length of the loss gradient by the centre, over all pixels."""

    def step(self, view: _CroppedView, background: Float[Tensor, "3"]) -> float:
        """One step on one view over one background; gives the loss."""
        options = RenderOptions(background=tuple(background.tolist()))
        drawn = render(self._with_leaves(self._leaves), view.camera, options=options).color
        target = view.mask * view.image + (1 - view.mask) * background.to(view.image)
        loss = (view.weight * (drawn[0] - target).abs()).mean()
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if (gradient := self._leaves["means"].grad) is not None:
            self.scores += gradient.norm(dim=1) * view.weight.numel()
        self._optimizer.step()
        return loss.item()

    @property
    def gaussians(self) -> Gaussians:
        """The object as it is fitted so far."""
        return self._with_leaves({name: leaf.detach() for name, leaf in self._leaves.items()})

    @staticmethod
    def _with_leaves(leaves: dict[str, Tensor]) -> Gaussians:
        fields = {name: leaf for name, leaf in leaves.items() if name not in ("base", "higher")}
        return Gaussians(sh=torch.cat([leaves["base"], leaves["higher"]], 1), **fields)


def _with_splits(gaussians: Gaussians, scores: Float[Tensor, "n"], allowed: int) -> Gaussians:
    """At most `allowed` Gaussians: those with the highest scores split along their longest axis, transparent ones left
    out."""
    alive = gaussians.opacities > _DEAD_OPACITY
    count = int(alive.sum())
    parents = min((allowed - count) // (PIECES - 1), count)
    if parents <= 0:
        return gaussians
    chosen = torch.zeros_like(alive)
    chosen[torch.where(alive, scores, -1.0).topk(parents).indices] = True
    split = gaussians.select(chosen)
    pieces, _ = split_along(split, split.log_scales.argmax(1))
    return concatenate([gaussians.select(alive & ~chosen), pieces])


def _with_known_colors(gaussians: Gaussians, views: Sequence[_CroppedView]) -> Gaussians:
    """The Gaussians that hardly show in any view with the mean colour of the nearest that do, from all sides alike."""
    shown = torch.zeros(gaussians.count, device=gaussians.device)
    for view in views:
        ones = torch.ones_like(view.mask)
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
) -> _CroppedView | None:
    """The view cropped to where the object shows; None where the mask is empty."""
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
    device = scene.device
    return _CroppedView(
        camera=camera.cropped([(left, top, right, bottom)]),
        image=image[top:bottom, left:right].to(device),
        mask=mask[top:bottom, left:right, None].to(device),
        weight=(~hidden[top:bottom, left:right, None]).float(),
    )
