"""Reconstruction of a scene: initial Gaussians, schedules of learning rates and density, and the fit.

Learning rates are 3DGS's published ones for 30000 steps. A shorter run takes larger ones and starts from more opaque
Gaussians. Measured on a room of 36 views at 352x248, 25k Gaussians, 1000 steps, held-out PSNR: published rates
25.2 dB, twice 26.7, four times 27.5, four times with initial opacity 0.5 and rates that fall at the end 27.8, and with
rates other than the centres' eight times 28.1 (a bunch of bananas, 16 photographs: 29.0 and 29.1).
"""

import math
from dataclasses import dataclass, field, replace

import torch

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.fitting import FitOptions, FitState, LearningRates, Step, fit
from splatgraft.reconstruction.density import DensityControl
from splatgraft.reconstruction.far_shell import ShellOptions, shell_points, shell_radius, shows_surroundings
from splatgraft.reconstruction.image_pyramid import Pyramid, read_pyramid
from splatgraft.reconstruction.initialization import SeedPoints, from_points, looked_at, random_seeds, scene_extent
from splatgraft.reconstruction.mcmc import McmcControl, McmcOptions
from splatgraft.reconstruction.memory import require_memory
from splatgraft.reconstruction.options import ReconstructOptions
from splatgraft.reconstruction.plane_sweep import SweepOptions, sweep
from splatgraft.rendering import RenderOptions
from splatgraft.runtime.progress import Checkpoint, NoCheckpoint, Progress, silent


@dataclass(frozen=True)
class ScheduleOptions:
    """Schedules of a reconstruction; 3DGS's for 30000 steps, shorter runs by the measurements above."""

    published_iterations: int = 30_000
    """Steps for which the published values hold (3DGS)."""
    few_points: int = 1000
    """Sparse points below which more are found by a plane sweep."""
    fewest_points: int = 100
    """Points of both kinds below which random ones are taken."""
    sweep: SweepOptions = field(default_factory=SweepOptions)
    """The search for points where the capture has none."""
    shell: ShellOptions = field(default_factory=ShellOptions)
    """The shell behind the scene, where the options ask for one."""
    start_share: float = 0.6
    """Gaussians at the start at most, over the budget; the others come where the density control wants them."""
    published_opacity: float = 0.1
    """Opacity at the start of a run of the published length or longer (3DGS)."""
    short_run_opacity: float = 0.5
    """Opacity at the start of a shorter run."""
    band_share: int = 30
    """All steps over the steps between two bands of colour."""
    densify_every: int = 100
    """Most steps between two densifications (3DGS)."""
    densifications: int = 20
    """Least number of densification intervals in a run."""
    full_at: float = 0.6
    """Share of the steps after which the budget may be reached."""
    stop_at: float = 0.8
    """Share of the steps after which Gaussians are neither split nor removed."""
    mcmc: McmcOptions = field(default_factory=McmcOptions)
    """Settings of the density control `mcmc`, whose schedule follows."""
    mcmc_start: int = 500
    """Step of a run of the published length after which it relocates and adds (3DGS-MCMC)."""
    mcmc_stop: int = 25_000
    """Step from which it does not."""
    error_every: int = 4
    """Steps between two measurements of the error that each Gaussian covers, where the options ask for it."""
    means_power: float = 0.5
    """Exponent of the published length over the run's, the factor on the rate of the centres."""
    most_means: float = 4.0
    """Bound on that factor."""
    others_power: float = 0.6
    """The same exponent for all other rates."""
    most_others: float = 8.0
    """Bound on that factor."""
    color_rate: float = 0.003
    """Learning rate of each photograph's own affine map of colours."""
    short_run_final: float = 0.1
    """Last rate over the first, for all but the centres, in a shorter run."""


def reconstruct(
    capture: PosedImages,
    options: ReconstructOptions = ReconstructOptions(),
    *,
    schedule: ScheduleOptions = ScheduleOptions(),
    progress: Progress = silent,
    checkpoint: Checkpoint = NoCheckpoint(),
) -> Gaussians:
    """Fit Gaussians to a capture (3D Gaussian Splatting, Kerbl et al. 2023; density control after Taming 3DGS).

    Args:
        capture: Posed images; sparse points are the start where there are at least 100.
        options: Length, size, resolution and seed.
        schedule: Learning rates and density over the run.
        progress: Called with steps done, steps in all and a short text.
        checkpoint: Where the state is saved, and from where a run that was stopped continues.

    Returns:
        At most `options.most_gaussians` Gaussians in the frame of the cameras, on `options.device`.

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
    options = options.decided(_show_surroundings(views, options, schedule))
    start = _start(capture, views, options, schedule, progress=progress).to(options.device)
    by_mcmc = options.density_control == "mcmc"
    density = _mcmc(options, schedule) if by_mcmc else _density(options, schedule, start.count, cameras=capture.cameras)
    control = _Control(options.sh_degree, max(1, options.all_iterations // schedule.band_share), density)
    fit_options = FitOptions(
        iterations=options.all_iterations,
        rates=_rates(capture.cameras, options, schedule),
        opacity_penalty=schedule.mcmc.opacity_penalty if by_mcmc else 0.0,
        scale_penalty=schedule.mcmc.scale_penalty if by_mcmc else 0.0,
        seed=options.seed,
        view_color_rate=schedule.color_rate if options.photo_colors else 0.0,
        rendering=RenderOptions(background=options.background),
        random_background=bool(options.random_background),
    )
    fitted = fit(start, views, options=fit_options, control=control, progress=progress, checkpoint=checkpoint)
    return fitted.with_sh_degree(options.sh_degree)


@dataclass(frozen=True)
class _Control:
    """The `Control` of the fit: density, and one more band of colour every `band_every` steps."""

    sh_degree: int
    band_every: int
    density: DensityControl | McmcControl

    def __call__(self, state: FitState, step: Step) -> FitState:
        state = self.density.update(state, step)
        degree = min(self.sh_degree, state.iteration // self.band_every)
        if degree <= state.gaussians.sh_degree:
            return state
        wider = state.gaussians.with_sh_degree(degree)
        return replace(state, gaussians=wider, moments=state.moments.padded("sh", wider.sh.shape[1]))


def _start(
    capture: PosedImages, views: Pyramid, options: ReconstructOptions, schedule: ScheduleOptions, *, progress: Progress
) -> Gaussians:
    """Gaussians at sparse points; of few, also at points of a plane sweep; else at random."""
    most = max(1, int(schedule.start_share * options.most_gaussians))
    seeds = SeedPoints(
        capture.points.float(), capture.point_colors.float(), torch.full((len(capture.points),), torch.inf)
    )
    if len(seeds) < schedule.few_points:
        cameras, images = views.reduced(schedule.sweep.longest_side_px)
        reach = looked_at(capture.cameras)[1]
        swept = sweep(cameras, images, known=seeds.points, reach=reach, options=schedule.sweep)
        found = f"{len(seeds) or 'no'} sparse points"
        seeds = seeds.joined(swept)
        if len(seeds) < schedule.fewest_points:
            seeds = random_seeds(capture.cameras, count=max(options.most_gaussians // 4, 1), seed=options.seed)
            found = f"{found}: starting from {len(seeds)} random ones where the cameras look"
        else:
            found = f"{found}: {len(swept)} found by comparing views"
        progress(0, options.all_iterations, found)
    shell = _shell(capture, views, options.most_gaussians, schedule.shell) if options.far_shell else SeedPoints.none()
    start = from_points(seeds.drawn(max(1, most - len(shell)), options.seed))
    if len(shell):
        # apart from the others, whose spacing bounds that of isolated points
        start = concatenate([start, from_points(shell)])
    if options.density_control == "mcmc":
        opacity = torch.full_like(start.opacity_logits, schedule.mcmc.start_opacity)
        log_scales = start.log_scales + math.log(schedule.mcmc.start_scale)
        return replace(start, opacity_logits=opacity.logit(), log_scales=log_scales)
    short = options.all_iterations < schedule.published_iterations
    opacity = schedule.short_run_opacity if short else schedule.published_opacity
    return replace(start, opacity_logits=torch.full_like(start.opacity_logits, opacity).logit())


def _show_surroundings(views: Pyramid, options: ReconstructOptions, schedule: ScheduleOptions) -> bool:
    _, images = views.reduced(schedule.shell.longest_side_px)
    return shows_surroundings(images, options.background, schedule.shell)


def _shell(capture: PosedImages, views: Pyramid, budget: int, options: ShellOptions) -> SeedPoints:
    """Points behind the scene."""
    cameras, images = views.reduced(options.longest_side_px)
    focus, reach = looked_at(capture.cameras)
    radius = shell_radius(capture.points, focus, reach, options)
    count = max(1, int(options.share * budget))
    return shell_points(cameras, images, center=focus, radius=radius, count=count, margin_deg=options.margin_deg)


def _mcmc(options: ReconstructOptions, schedule: ScheduleOptions) -> McmcControl:
    n, published = options.all_iterations, schedule.published_iterations
    return McmcControl(
        budget=options.most_gaussians,
        start=n * schedule.mcmc_start // published,
        stop=n * schedule.mcmc_stop // published,
        every=_densify_every(n, schedule),
        seed=options.seed,
        options=schedule.mcmc,
    )


def _densify_every(iterations: int, schedule: ScheduleOptions) -> int:
    return max(1, min(schedule.densify_every, iterations // schedule.densifications))


def _density(
    options: ReconstructOptions, schedule: ScheduleOptions, first_count: int, *, cameras: Cameras
) -> DensityControl:
    n = options.all_iterations
    return DensityControl(
        budget=options.most_gaussians,
        first_count=first_count,
        every=_densify_every(n, schedule),
        full_at=int(schedule.full_at * n),
        stop=int(schedule.stop_at * n),
        camera_centers=cameras.centers.to(options.device),
        error_every=schedule.error_every if options.splits_by_error else 0,
    )


def _rates(cameras: Cameras, options: ReconstructOptions, schedule: ScheduleOptions) -> LearningRates:
    """3DGS's published rates, higher for shorter runs."""
    extent = scene_extent(cameras)
    shorter = max(1.0, schedule.published_iterations / options.all_iterations)
    means_factor = min(schedule.most_means, shorter**schedule.means_power)
    factor = min(schedule.most_others, shorter**schedule.others_power)
    return LearningRates(
        means=1.6e-4 * extent * means_factor,
        means_final=1.6e-6 * extent * means_factor,
        log_scales=0.005 * factor,
        quaternions=0.001 * factor,
        opacity_logits=(schedule.mcmc.opacity_rate if options.density_control == "mcmc" else 0.025) * factor,
        sh=0.0025 * factor,
        sh_higher=0.0025 / 20 * factor,
        final=schedule.short_run_final if shorter > 1 else 1.0,
    )
