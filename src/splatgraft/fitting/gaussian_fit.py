"""Fit of Gaussians to images by gradient descent (Kerbl et al. 2023, 3D Gaussian Splatting).

Each step

1. renders one view;
2. computes the loss (3DGS, Eq. 7), optionally with losses on depth and a colour map of the view;
3. updates the visible Gaussians by sparse Adam;
4. calls the density control.

Step i depends only on the state after step i - 1, the seed and i. A run resumed from a checkpoint therefore gives the
same bits as an uninterrupted one.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.fitting import adam
from splatgraft.fitting.photometric import l1_dssim
from splatgraft.fitting.surface_loss import SurfaceLoss
from splatgraft.rendering import Output, RenderOptions, render
from splatgraft.runtime.process import interruption_held
from splatgraft.runtime.progress import Checkpoint, NoCheckpoint, Progress, silent

_REPORT_EVERY = 10  # steps
_CHECKPOINT_SECONDS = 30.0
_COPRIME = 3  # step through the cells of a stride; coprime to 4 and 16, so visits reach all cells of strides 2 and 4
MIN_SIDE_PX = 32
"""Smallest side of a fitted image, pixels; in smaller ones the 11-pixel window of SSIM covers most of the image."""


@dataclass(frozen=True)
class View:
    """One camera and its target image."""

    camera: Cameras
    """A batch of one."""
    image: UInt8[Tensor, "h w 3"]
    """Target image, sRGB times 255."""
    mask: UInt8[Tensor, "h w 1"] | None = None
    """Foreground share of each pixel times 255; the rest shows the background. None: all foreground."""
    is_compared: Bool[Tensor, "h w 1"] | None = None
    """Pixels that count in the loss; None: all."""
    low_pass_px2: float = RenderOptions.low_pass_px2
    """Low pass of the rendering, pixels squared."""

    def every_nth(self, stride: int, *, visit: int, index: int) -> "View":
        """Take every `stride`-th pixel along both axes, without averaging; small views stay whole.

        The first pixel changes with `visit` and `index`, so the gradient estimates that of all pixels.
        """
        if stride == 1 or min(self.image.shape[:2]) < stride * MIN_SIDE_PX:
            return self
        cell = (visit * _COPRIME + index) % stride**2
        left, top = cell % stride, cell // stride
        first = torch.tensor([left, top])
        intrinsics = self.camera.intrinsics.clone()
        intrinsics[:, :2] /= stride
        # the centre of the first pixel, left + 0.5, becomes 0.5
        intrinsics[:, :2, 2] += 0.5 - (first.to(intrinsics) + 0.5) / stride
        sizes = (self.camera.sizes - first + stride - 1) // stride
        return View(
            replace(self.camera, intrinsics=intrinsics, sizes=sizes),
            self.image[top::stride, left::stride],
            None if self.mask is None else self.mask[top::stride, left::stride],
            None if self.is_compared is None else self.is_compared[top::stride, left::stride],
            # the same low pass in pixels of the photograph
            self.low_pass_px2 / stride**2,
        )

    def target(self, background: Float[Tensor, "3"], drawn: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """Compute the target of a picture `drawn` over `background`; pixels that are not compared keep `drawn`."""
        target = self.image.float() / 255
        if self.mask is not None:
            share = self.mask.float() / 255
            target = share * target + (1 - share) * background
        return target if self.is_compared is None else torch.where(self.is_compared, target, drawn.detach())


class Views(Protocol):
    """The v photographs of a fit."""

    def __len__(self) -> int:
        """Number of photographs, v."""
        ...

    def at(self, index: int, *, visit: int, done: float) -> View:
        """Return view `index` at its visit number `visit` (from 0), after the share `done` in [0, 1] of all steps."""
        ...


@dataclass(frozen=True)
class LearningRates:
    """Learning rate of Adam for each field; a field with rate 0 is frozen and no gradient is computed for it."""

    means: float = 0.0
    """Rate of the centres at the start, world units."""
    means_final: float = 0.0
    """Rate of the centres at the end, world units; it decreases exponentially from `means`."""
    log_scales: float = 0.0
    """Rate of the natural logarithms of the scales."""
    quaternions: float = 0.0
    """Rate of the raw quaternion components."""
    opacity_logits: float = 0.0
    """Rate of the opacities before the sigmoid."""
    sh: float = 0.0
    """Rate of band 0."""
    sh_higher: float = 0.0
    """Rate of bands 1 to 3; a twentieth of band 0 in 3DGS."""
    view_colors: float = 0.0
    """Rate of the views' affine colour maps at the start; it decreases to 0 along half a cosine. 0 fits no maps."""
    final: float = 1.0
    """Factor on the other rates at the end; reached along half a cosine in the last third."""

    def active(self) -> tuple[str, ...]:
        """Return the names of the fields that are fitted."""
        names = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
        return tuple(name for name in names if getattr(self, name) > 0)

    def at(self, field: str, done: float, columns: int) -> Float[Tensor, "c"]:
        """Compute the rates of the `columns` values of `field` per Gaussian, after the share `done` of all steps."""
        if field == "means":
            fallen = (self.means_final / self.means) ** done if self.means_final > 0 else 1.0
            return torch.full((columns,), self.means * fallen)
        late = min(max(3 * done - 2, 0.0), 1.0)
        cosine = 0.5 + 0.5 * torch.cos(torch.tensor(torch.pi * late))
        left = self.final + (1 - self.final) * float(cosine)
        rates = torch.full((columns,), getattr(self, field) * left)
        if field == "sh":
            rates[3:] = self.sh_higher * left
        return rates


@dataclass(frozen=True)
class FitOptions:
    """Length, rates, background and seed of a fit."""

    iterations: int
    """Number of steps, one view each."""
    rates: LearningRates
    """Learning rate of every field."""
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    """Colour behind the scene, sRGB in [0, 1]; None: random at every step, so that dark surfaces get no holes."""
    view_gains: Sequence[float] | None = None
    """Initial brightness of each view's colour map, over the mean of all views; None: equal."""
    surfaces: SurfaceLoss | None = None
    """Losses on depth, if any."""
    seed: int = 0
    """Seed of the order of views and of random backgrounds."""


@dataclass(frozen=True)
class ViewColors:
    """Affine colour map of each of v photographs, for its exposure and white balance, with Adam's moments.

    A map takes the scene's colours to the photograph's (12 numbers instead of the embeddings of Martin-Brualla et al.
    2021). The mean of all maps stays the identity, so that the scene has the mean appearance.
    """

    maps: Float[Tensor, "v 3 4"]
    """Matrix and offset of each view, minus the identity."""
    first: Float[Tensor, "v 3 4"]
    """Running mean of gradients."""
    second: Float[Tensor, "v 3 4"]
    """Running mean of squared gradients."""
    steps: Int[Tensor, "v"]
    """Number of updates of each view."""

    @staticmethod
    def start(gains: Float[Tensor, "v"]) -> "ViewColors":
        """Make maps that multiply colours by each view's gain; the mean of all gains becomes 1."""
        maps = (gains - gains.mean())[:, None, None] * torch.eye(3, 4, device=gains.device)
        zeros = torch.zeros_like(maps)
        return ViewColors(maps, zeros, zeros, torch.zeros(len(gains), dtype=torch.int32, device=gains.device))

    def of(self, view: int) -> Float[Tensor, "3 4"]:
        """Return matrix and offset from the scene's colours to the view's."""
        return self.maps[view] + torch.eye(3, 4, device=self.maps.device)

    def updated(self, view: int, gradient: Float[Tensor, "3 4"], rate: float) -> "ViewColors":
        """Update one view's map by Adam, and subtract the mean of all maps."""
        # a view has only tens of updates, too few for the usual beta_2 of 0.999
        beta_1, beta_2, epsilon = 0.9, 0.99, 1e-12
        maps, first, second, steps = (tensor.clone() for tensor in (self.maps, self.first, self.second, self.steps))
        steps[view] += 1
        first[view] = beta_1 * first[view] + (1 - beta_1) * gradient
        second[view] = beta_2 * second[view] + (1 - beta_2) * gradient**2
        count = int(steps[view])
        mean, square = first[view] / (1 - beta_1**count), second[view] / (1 - beta_2**count)
        maps[view] -= rate * mean / (square.sqrt() + epsilon)
        return ViewColors(maps - maps.mean(0), first, second, steps)


@dataclass(frozen=True)
class FitState:
    """State of a fit after a step."""

    iteration: int
    """Number of steps done."""
    gaussians: Gaussians
    """Fitted scene."""
    moments: adam.Moments
    """Adam's moments of the fitted fields."""
    view_colors: ViewColors
    """Colour map of each view."""
    memory: dict[str, Tensor] = field(default_factory=dict)
    """Tensors that the control keeps between steps."""

    def select(self, which: Tensor) -> "FitState":
        """Return the state of the chosen Gaussians (indices or mask) with an empty `memory`."""
        return replace(self, gaussians=self.gaussians.select(which), moments=self.moments.select(which), memory={})


@dataclass(frozen=True)
class Step:
    """Results of the last step for the control."""

    camera: Cameras
    """Camera of the view."""
    visible: Bool[Tensor, "n"]
    """Gaussians in the view."""
    gradients: dict[str, Tensor]
    """Gradients of the loss, by field."""
    residual: Float[Tensor, "h w 3"]
    """Rendered image minus target, sRGB."""
    rendering: RenderOptions
    """Options of the rendering."""


Control = Callable[[FitState, Step], FitState]
"""Called after every step; may add, change and remove Gaussians, and store tensors in `memory`."""


def fit(
    gaussians: Gaussians,
    views: Views,
    options: FitOptions,
    *,
    control: Control | None = None,
    progress: Progress = silent,
    checkpoint: Checkpoint = NoCheckpoint(),
) -> Gaussians:
    """Fit the fields of `gaussians` with a learning rate above 0 to the images of `views`.

    Args:
        gaussians: Initial Gaussians.
        views: At least one view.
        options: Length, rates, background and seed.
        control: Called after every step.
        progress: Called with steps done, steps in all and a short text.
        checkpoint: Storage of the state, written every 30 seconds and on Ctrl-C; a stopped run continues from it.

    Raises:
        ValueError: The loss or a gradient is not finite.
    """
    names = options.rates.active()
    saved = checkpoint.load()
    gains = torch.tensor([1.0] * len(views) if options.view_gains is None else list(options.view_gains))
    state = _start(gaussians, names, gains) if saved is None else _unpacked(saved, gaussians.device)
    last_save, recent = time.monotonic(), 0.0
    with interruption_held() as interrupted:
        while state.iteration < options.iterations:
            state, value, step = _stepped(state, views, options)
            if control is not None:
                state = control(state, step)
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


def _stepped(state: FitState, views: Views, options: FitOptions) -> tuple[FitState, float, Step]:
    """Do one step on one view; return the new state, the loss, and the results for the control."""
    rates, done = options.rates, state.iteration / options.iterations
    names = rates.active()
    visit, place = divmod(state.iteration, len(views))
    # each pass visits all views in an order that depends on seed and pass only
    index = int(torch.randperm(len(views), generator=_generator(options.seed, visit))[place])
    view = views.at(index, visit=visit, done=done)
    rendering = RenderOptions(background=_background(options, state.iteration), low_pass_px2=view.low_pass_px2)
    leaves = {name: getattr(state.gaussians, name).detach().requires_grad_() for name in names}
    outputs: frozenset[Output] = frozenset({"color"} if options.surfaces is None else {"color", "inverse_depth"})
    drawn = render(replace(state.gaussians, **leaves), view.camera, outputs=outputs, options=rendering)
    fits_colors = rates.view_colors > 0
    colors = state.view_colors.of(index).requires_grad_(fits_colors)
    picture, background = drawn.color[0], torch.tensor(rendering.background, device=colors.device)
    if fits_colors:
        picture, background = (x @ colors[:, :3].T + colors[:, 3] for x in (picture, background))
    target = view.target(background, picture)
    loss = l1_dssim(picture, target)
    if options.surfaces is not None:
        drawing, photo = _generator(options.seed, state.iteration, plus=2), target.detach()
        loss = loss + options.surfaces.loss(drawn.inverse_depth[0], drawn.alpha[0], photo, generator=drawing)
    value = float(loss.detach())
    if not math.isfinite(value):
        raise _diverged(state, f"a loss of {value}")
    found = torch.autograd.grad(loss, [*leaves.values(), *([colors] if fits_colors else [])])
    gradients = dict(zip(names, found[: len(names)], strict=True))
    if fits_colors:
        rate = rates.view_colors * (0.5 + 0.5 * math.cos(math.pi * done))
        state = replace(state, view_colors=state.view_colors.updated(index, found[-1], rate))
    values = {name: leaf.detach() for name, leaf in leaves.items()}
    of_fields = {name: rates.at(name, done, v[0].numel() if len(v) else 1) for name, v in values.items()}
    if not adam.step(values, gradients, moments=state.moments, rates=of_fields, visible=drawn.visible[0]):
        raise _diverged(state, "a gradient that is not finite")
    step = Step(view.camera, drawn.visible[0], gradients, (picture - target).detach(), rendering)
    return replace(state, iteration=state.iteration + 1), value, step


def _diverged(state: FitState, found: str) -> ValueError:
    return ValueError(
        f"fit: expected finite numbers, found {found} at step {state.iteration} (the last checkpoint is kept); "
        "lower the learning rates or look for broken images and cameras"
    )


def _background(options: FitOptions, iteration: int) -> tuple[float, float, float]:
    if options.background is not None:
        return options.background
    # uniform in sRGB; depends on seed and iteration only
    red, green, blue = torch.rand(3, generator=_generator(options.seed, iteration, plus=1)).tolist()
    return red, green, blue


def _generator(seed: int, number: int, plus: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed((seed * 1_000_003 + number) % 2**62 + plus)


def _start(gaussians: Gaussians, names: tuple[str, ...], gains: Float[Tensor, "v"]) -> FitState:
    own = gaussians.map(lambda tensor: tensor.detach().clone().contiguous())
    moments = adam.no_moments({name: getattr(own, name) for name in names}, own.count)
    return FitState(0, own, moments, ViewColors.start(gains.to(own.device)))


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
