"""Reconstruction of a scene: initial Gaussians, schedules of learning rates and density, and the fit.

Learning rates are 3DGS's published ones for 30000 steps. A shorter run has higher rates and starts from more opaque
Gaussians. Held-out PSNR on a room (36 views of 352x248 pixels, 25k Gaussians, 1000 steps):

- published rates: 25.2 dB; twice these: 26.7; four times: 27.5;
- four times, with initial opacity 0.5 and rates that decrease at the end: 27.8 (16 photographs of bananas: 29.0);
- the same, with all rates but the centres' eight times: 28.1 (bananas: 29.1).
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.fitting.density import DensityControl
from splatgraft.fitting.gaussian_fit import FitOptions, FitState, LearningRates, Step, fit
from splatgraft.fitting.surface_loss import SurfaceLoss
from splatgraft.reconstruction.image_pyramid import read_pyramid
from splatgraft.reconstruction.initialization import (
    SeedPoints,
    from_points,
    looked_at,
    random_seeds,
    scene_extent,
    shell_points,
    shell_radius,
    shows_surroundings,
)
from splatgraft.reconstruction.options import ReconstructOptions, require_memory
from splatgraft.reconstruction.plane_sweep import sweep
from splatgraft.runtime.progress import Checkpoint, NoCheckpoint, Progress, silent

_PUBLISHED_ITERATIONS = 30_000  # steps for which the published values hold (3DGS)
_MIN_POINTS = 100  # sparse and swept points below which random ones replace them
_SMALL_SIDE_PX = 160  # longest side of the images of the plane sweep and of the far shell's colours
_SHELL_SHARE = 0.05  # Gaussians of the far shell over the budget; set by hand
_START_SHARE = 0.6  # most Gaussians at the start, over the budget; density control adds the others
_PUBLISHED_OPACITY, _SHORT_RUN_OPACITY = 0.1, 0.5  # initial opacity at the published length (3DGS), and below it
_BAND_SHARE = 30  # number of steps over the steps between two bands of colour
_DENSIFY_EVERY, _MIN_DENSIFICATIONS = 100, 20  # most steps between densifications (3DGS), and fewest densifications
_FULL_AT, _STOP_AT = 0.6, 0.8  # shares of the steps at which the budget is reached, and after which density is fixed
_MEANS_POWER, _MAX_MEANS = 0.5, 4.0  # factor on the rate of the centres: (published / own length)^power, and its bound
_OTHERS_POWER, _MAX_OTHERS = 0.6, 8.0  # the same for all other rates
_COLOR_RATE = 0.003  # learning rate of each photograph's own affine map of colours
_SHORT_RUN_FINAL = 0.1  # last rate over the first in a shorter run, except for the centres


def reconstruct(
    capture: PosedImages,
    options: ReconstructOptions = ReconstructOptions(),
    *,
    progress: Progress = silent,
    checkpoint: Checkpoint = NoCheckpoint(),
) -> Gaussians:
    """Fit Gaussians to a capture (3D Gaussian Splatting, Kerbl et al. 2023; density control after Taming 3DGS).

    Args:
        capture: Posed images; Gaussians start at the sparse points, and at points of a plane sweep between them.
        options: Length, size, resolution and seed.
        progress: Called with steps done, steps in all and a short text.
        checkpoint: Storage of the state; a stopped run continues from it.

    Returns:
        At most `options.max_gaussians` Gaussians in the frame of the cameras, on `options.device`.

    Raises:
        ValueError: There are fewer than 2 views or too little memory, or a value stops being finite.
    """
    require_memory(capture, options)
    if options.eval_every:
        capture = capture.select(~held_out(len(capture), options.eval_every))
    if len(capture) < 2:
        raise ValueError(f"reconstruct: expected at least 2 views to fit, found {len(capture)}")
    capture = options.served(capture)
    views = read_pyramid(capture, options.sampling(capture.cameras), device=options.device, progress=progress)
    small = views.reduced(_SMALL_SIDE_PX)
    surroundings = shows_surroundings(small[1], options.background)
    start = _start(capture, small, options, far_shell=surroundings, progress=progress).to(options.device)
    density = DensityControl(
        budget=options.max_gaussians,
        first_count=start.count,
        every=max(1, min(_DENSIFY_EVERY, options.all_iterations // _MIN_DENSIFICATIONS)),
        full_at=int(_FULL_AT * options.all_iterations),
        stop=int(_STOP_AT * options.all_iterations),
        camera_centers=capture.cameras.centers.to(options.device),
    )
    band_every = max(1, options.all_iterations // _BAND_SHARE)

    def control(state: FitState, step: Step) -> FitState:
        """Update the density, and add a band of colour every `band_every` steps."""
        state = density.update(state, step)
        degree = min(options.sh_degree, state.iteration // band_every)
        if degree <= state.gaussians.sh_degree:
            return state
        wider = state.gaussians.with_sh_degree(degree)
        return replace(state, gaussians=wider, moments=state.moments.padded("sh", wider.sh.shape[1]))

    how = FitOptions(
        options.all_iterations,
        _rates(capture.cameras, options),
        background=None if surroundings else options.background,
        surfaces=SurfaceLoss(unit=looked_at(capture.cameras)[1]),
        seed=options.seed,
    )
    fitted = fit(start, views, how, control=control, progress=progress, checkpoint=checkpoint)
    return fitted.with_sh_degree(options.sh_degree)


def _start(
    capture: PosedImages,
    small: tuple[list[Cameras], list[Float[Tensor, "_ _ 3"]]],
    options: ReconstructOptions,
    *,
    far_shell: bool,
    progress: Progress,
) -> Gaussians:
    """Make Gaussians at sparse and swept points, at random ones if these are few, and the far shell."""
    focus, reach = looked_at(capture.cameras)
    budget = options.max_gaussians
    seeds = SeedPoints(
        capture.points.float(), capture.point_colors.float(), torch.full((len(capture.points),), torch.inf)
    )
    swept = sweep(*small, known=seeds.points, reach=reach)
    found = f"{len(seeds) or 'no'} sparse points"
    seeds = seeds.joined(swept)
    if len(seeds) < _MIN_POINTS:
        seeds = random_seeds(capture.cameras, count=max(budget // 4, 1), seed=options.seed)
        found = f"{found}: starting from {len(seeds)} random ones where the cameras look"
    else:
        found = f"{found}, {len(swept)} more by comparing views"
    progress(0, options.all_iterations, found)
    shell = SeedPoints.none()
    if far_shell:
        radius = shell_radius(capture.points, focus, reach)
        shell = shell_points(*small, center=focus, radius=radius, count=max(1, int(_SHELL_SHARE * budget)))
    most = max(1, int(_START_SHARE * budget))
    start = from_points(seeds.drawn(max(1, most - len(shell)), options.seed))
    if len(shell):
        # made separately, because the widths of the shell's Gaussians would be bounded by those of the others
        start = concatenate([start, from_points(shell)])
    opacity = _SHORT_RUN_OPACITY if options.all_iterations < _PUBLISHED_ITERATIONS else _PUBLISHED_OPACITY
    return replace(start, opacity_logits=torch.full_like(start.opacity_logits, opacity).logit())


def _rates(cameras: Cameras, options: ReconstructOptions) -> LearningRates:
    """Return 3DGS's published rates, increased for shorter runs."""
    extent = scene_extent(cameras)
    shorter = max(1.0, _PUBLISHED_ITERATIONS / options.all_iterations)
    means_factor = min(_MAX_MEANS, shorter**_MEANS_POWER)
    factor = min(_MAX_OTHERS, shorter**_OTHERS_POWER)
    return LearningRates(
        means=1.6e-4 * extent * means_factor,
        means_final=1.6e-6 * extent * means_factor,
        log_scales=0.005 * factor,
        quaternions=0.001 * factor,
        opacity_logits=0.025 * factor,
        sh=0.0025 * factor,
        sh_higher=0.0025 / 20 * factor,
        view_colors=_COLOR_RATE if options.photo_colors else 0.0,
        final=_SHORT_RUN_FINAL if shorter > 1 else 1.0,
    )
