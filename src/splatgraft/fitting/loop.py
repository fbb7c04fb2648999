"""The loop that fits Gaussians to images: render, loss, gradient, sparse Adam.

Step i depends only on the state after step i - 1, the seed and i, so that a run resumed from a checkpoint gives the
same bits as an uninterrupted one.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.fitting import adam
from splatgraft.fitting.learning_rates import LearningRates
from splatgraft.fitting.photometric import l1_dssim
from splatgraft.fitting.view_colors import ViewColors, apply_colors, rate_at
from splatgraft.rendering import RenderOptions, render
from splatgraft.runtime.interruption import interruption_held
from splatgraft.runtime.progress import Checkpoint, NoCheckpoint, Progress, silent

Loss = Callable[[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]], Float[Tensor, ""]]
"""From the rendered and the target image to a scalar."""

_REPORT_EVERY = 10
"""Steps."""
_CHECKPOINT_SECONDS = 30.0


@dataclass(frozen=True)
class View:
    """One camera and its target image."""

    camera: Cameras
    """A batch of one."""
    image: Float[Tensor, "h w 3"]
    """sRGB."""
    low_pass_px2: float | None = None
    """Low pass of the rendering where it is not that of the fit's options, pixels squared."""


@runtime_checkable
class Views(Protocol):
    """The images to fit."""

    def __len__(self) -> int:
        """Number of views."""
        ...

    def at(self, index: int, *, visit: int, done: float) -> View:
        """One view, when it is seen for the time `visit` (from 0), after the share `done` in [0, 1] of all steps."""
        ...


@dataclass(frozen=True)
class FixedViews:
    """`Views` that do not depend on the progress."""

    cameras: Cameras
    """One per image; sizes may differ."""
    images: tuple[Float[Tensor, "_ _ 3"], ...]
    """sRGB."""

    def __len__(self) -> int:
        """Number of views."""
        return len(self.images)

    def at(self, index: int, *, visit: int, done: float) -> View:
        """One camera and its image."""
        return View(self.cameras[index], self.images[index])


@dataclass(frozen=True)
class FitOptions:
    """Length, learning rates and loss of a fit."""

    iterations: int
    """Steps; each sees one view."""
    rates: LearningRates
    """Learning rates; fields with rate 0 are not fitted."""
    loss: Loss = l1_dssim
    """Loss to minimise."""
    view_color_rate: float = 0.0
    """Learning rate of each view's own affine map of colours at the start; 0 fits none."""
    seed: int = 0
    """Of the order of views."""
    rendering: RenderOptions = field(default_factory=RenderOptions)
    """Background, low-pass and near plane."""
    opacity_penalty: float = 0.0
    """Weight of the mean opacity in the loss (3DGS-MCMC); a penalty moves all Gaussians in every step, seen or not."""
    scale_penalty: float = 0.0
    """Weight of the mean scale in the loss, per world unit."""
    random_background: bool = False
    """Whether each step draws the scene over another colour, by chance, instead of that of `rendering`."""


@dataclass(frozen=True)
class FitState:
    """Everything besides options and views that the next step depends on."""

    iteration: int
    """Steps done."""
    gaussians: Gaussians
    """As fitted so far."""
    moments: adam.Moments
    """Of the fields that are fitted."""
    view_colors: ViewColors
    """Of each view over the scene."""
    memory: dict[str, Tensor] = field(default_factory=dict)
    """Tensors that the control stores between steps."""

    def select(self, which: Tensor) -> "FitState":
        """The state of the chosen Gaussians (indices or mask) with an empty `memory`."""
        return replace(self, gaussians=self.gaussians.select(which), moments=self.moments.select(which), memory={})


@dataclass(frozen=True)
class Step:
    """The last step, as the control sees it."""

    camera: Cameras
    """The view's camera."""
    visible: Bool[Tensor, "n"]
    """Gaussians in the view."""
    gradients: dict[str, Tensor]
    """Of the loss, by field."""
    rate_of_means: float
    """Learning rate of the centres in this step, world units."""
    residual: Float[Tensor, "h w 3"]
    """The rendered image minus the photograph, sRGB."""
    rendering: RenderOptions
    """With which it was rendered."""


Control = Callable[[FitState, Step], FitState]
"""Called after every step; may add, change and remove Gaussians, and store tensors in `memory`."""


def leave_unchanged(state: FitState, step: Step) -> FitState:
    """The `Control` that changes nothing."""
    return state


def fit(
    gaussians: Gaussians,
    views: Views,
    *,
    options: FitOptions,
    control: Control = leave_unchanged,
    progress: Progress = silent,
    checkpoint: Checkpoint = NoCheckpoint(),
) -> Gaussians:
    """Fit the fields of `gaussians` whose learning rate is above 0 to the images of `views`.

    Args:
        gaussians: Start of the fit; stays unchanged.
        views: Cameras and target images.
        options: Length, rates and loss.
        control: Called after every step, as for density control.
        progress: Called every ten steps.
        checkpoint: Where the state is saved every 30 seconds and on Ctrl-C, and from which a run is resumed.

    Raises:
        ValueError: Where there is no view, or where loss or gradients are not finite.
    """
    if len(views) == 0:
        raise ValueError("fit: expected at least one view, found none")
    names = options.rates.active()
    saved = checkpoint.load()
    state = _start(gaussians, names, len(views)) if saved is None else _unpacked(saved, gaussians.device)
    last_save, recent = time.monotonic(), 0.0
    with interruption_held() as interrupted:
        while state.iteration < options.iterations:
            done = state.iteration / options.iterations
            index = _view_of(state.iteration, len(views), options.seed)
            view = views.at(index, visit=state.iteration // len(views), done=done)
            image, camera = view.image, view.camera
            rendering = _rendering_of(view, state.iteration, options)
            leaves = {name: getattr(state.gaussians, name).detach().requires_grad_() for name in names}
            drawn = render(replace(state.gaussians, **leaves), camera, options=rendering)
            fits_colors = options.view_color_rate > 0
            colors = state.view_colors.of(index).requires_grad_(fits_colors)
            picture = apply_colors(drawn.color[0], colors) if fits_colors else drawn.color[0]
            loss = options.loss(picture, image)
            value = float(loss.detach())
            if not math.isfinite(value):
                raise _diverged(state, f"a loss of {value}")
            seen = drawn.visible[0]
            if options.opacity_penalty or options.scale_penalty:
                loss = loss + _penalty(leaves, options)
                seen = torch.ones_like(seen)
            found = torch.autograd.grad(loss, [*leaves.values(), *([colors] if fits_colors else [])])
            gradients = dict(zip(names, found[: len(names)], strict=True))
            if fits_colors:
                moved = state.view_colors.updated(index, found[-1], rate_at(options.view_color_rate, done))
                state = replace(state, view_colors=moved)
            values = {name: leaf.detach() for name, leaf in leaves.items()}
            columns = {name: v[0].numel() if len(v) else 1 for name, v in values.items()}
            rates = {name: options.rates.at(name, done, columns[name]) for name in names}
            if not adam.step(values, gradients, moments=state.moments, rates=rates, visible=seen):
                raise _diverged(state, "a gradient that is not finite")
            rate = options.rates.means_at(done) if "means" in names else 0.0
            last = Step(camera, seen, gradients, rate, picture.detach() - image, rendering)
            state = control(replace(state, iteration=state.iteration + 1), last)
            recent = value if recent == 0 else 0.95 * recent + 0.05 * value
            if state.iteration % _REPORT_EVERY == 0 or state.iteration == options.iterations:
                message = f"loss {recent:.4f}, {state.gaussians.count / 1000:.1f}k Gaussians"
                progress(state.iteration, options.iterations, message)
            due = interrupted() or time.monotonic() - last_save > _CHECKPOINT_SECONDS
            if due and not isinstance(checkpoint, NoCheckpoint):
                checkpoint.save(_packed(state))
                last_save = time.monotonic()
            if interrupted():
                raise KeyboardInterrupt
    return state.gaussians


def _penalty(leaves: dict[str, Tensor], options: FitOptions) -> Tensor | float:
    """The penalties on the fields that are fitted."""
    total: Tensor | float = 0.0
    if "opacity_logits" in leaves:
        total = total + options.opacity_penalty * leaves["opacity_logits"].sigmoid().mean()
    if "log_scales" in leaves:
        total = total + options.scale_penalty * leaves["log_scales"].exp().mean()
    return total


def _diverged(state: FitState, found: str) -> ValueError:
    return ValueError(
        f"fit: expected finite numbers, found {found} at step {state.iteration} (the last checkpoint stands); "
        "lower the learning rates or look for broken images and cameras"
    )


def _view_of(iteration: int, count: int, seed: int) -> int:
    """The view of an iteration: each pass visits all views in an order that depends on seed and pass only."""
    generator = torch.Generator().manual_seed((seed * 1_000_003 + iteration // count) % 2**62)
    return int(torch.randperm(count, generator=generator)[iteration % count])


def _rendering_of(view: View, iteration: int, options: FitOptions) -> RenderOptions:
    """How the view is drawn in an iteration."""
    rendering = options.rendering
    if view.low_pass_px2 is not None:
        rendering = replace(rendering, low_pass_px2=view.low_pass_px2)
    if options.random_background:
        rendering = replace(rendering, background=_background_of(iteration, options.seed))
    return rendering


def _background_of(iteration: int, seed: int) -> tuple[float, float, float]:
    """The colour behind the scene in an iteration, uniform in sRGB; depends on seed and iteration only."""
    generator = torch.Generator().manual_seed((seed * 1_000_003 + iteration) % 2**62 + 1)
    red, green, blue = torch.rand(3, generator=generator).tolist()
    return red, green, blue


def _start(gaussians: Gaussians, names: tuple[str, ...], views: int) -> FitState:
    own = gaussians.map(lambda tensor: tensor.detach().clone().contiguous())
    moments = adam.no_moments({name: getattr(own, name) for name in names}, own.count)
    return FitState(0, own, moments, ViewColors.identity(views, own.device))


def _packed(state: FitState) -> dict[str, Any]:
    return {
        "iteration": state.iteration,
        "gaussians": {f.name: getattr(state.gaussians, f.name) for f in fields(Gaussians)},
        "first": state.moments.first,
        "second": state.moments.second,
        "steps": state.moments.steps,
        "view_colors": {f.name: getattr(state.view_colors, f.name) for f in fields(ViewColors)},
        "memory": state.memory,
    }


def _unpacked(saved: dict[str, Any], device: torch.device) -> FitState:
    def placed(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        return {name: tensor.to(device).clone() for name, tensor in tensors.items()}

    return FitState(
        saved["iteration"],
        Gaussians(**placed(saved["gaussians"])),
        adam.Moments(placed(saved["first"]), placed(saved["second"]), saved["steps"].to(device).clone()),
        ViewColors(**placed(saved["view_colors"])),
        placed(saved["memory"]),
    )
