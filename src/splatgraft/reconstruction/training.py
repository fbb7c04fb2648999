"""Reconstruction of a scene: where it starts, its schedules, the fit. Knows nothing about files or rendering.

Rates are 3DGS's published ones for 30000 steps. A shorter run takes larger ones and starts from more opaque Gaussians.
Measured on a room of 36 views at 352x248, 25k Gaussians, 1000 steps, held-out PSNR: published rates 25.2 dB, twice
26.7, four times 27.5, four times with initial opacity 0.5 and rates that fall at the end 27.8, and with rates other
than the centres' eight times 28.1 (a bunch of bananas, 16 photographs: 29.0 and 29.1).
"""

from dataclasses import dataclass, replace

import torch

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.fitting import FitOptions, FitState, Rates, Step, fit
from splatgraft.reconstruction.density import Density
from splatgraft.reconstruction.image_pyramid import read_pyramid
from splatgraft.reconstruction.initial import from_points, random_points, scene_extent
from splatgraft.reconstruction.memory import require_memory
from splatgraft.reconstruction.options import ReconstructOptions
from splatgraft.rendering import RenderOptions
from splatgraft.runtime.progress import Checkpoint, NoCheckpoint, Progress, silent

PUBLISHED_ITERATIONS = 30_000
_FEWEST_POINTS = 100
_PUBLISHED_OPACITY, _SHORT_RUN_OPACITY = 0.1, 0.5
_COARSE_TO_FINE = ((0.5, 0.3), (0.7071, 0.6), (1.0, 1.0))
_AS_IT_IS = ((1.0, 1.0),)


def reconstruct(
    capture: PosedImages,
    options: ReconstructOptions = ReconstructOptions(),
    *,
    progress: Progress = silent,
    checkpoint: Checkpoint = NoCheckpoint(),
) -> Gaussians:
    """Fit Gaussians to a capture (3D Gaussian Splatting, Kerbl et al. 2023; their number as in Taming 3DGS).

    Args:
        capture: Posed images; sparse points are the start where there are at least 100.
        options: Length, size, resolution and seed.
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
    start = _start(capture, options, progress).to(options.device)
    schedule = _COARSE_TO_FINE if options.coarse_to_fine else _AS_IT_IS
    views = read_pyramid(capture, schedule, device=options.device, progress=progress)
    control = _Control(
        options.sh_degree, max(1, options.all_iterations // 30), _density(options, start.count, capture.cameras)
    )
    fit_options = FitOptions(
        iterations=options.all_iterations,
        rates=_rates(capture.cameras, options.all_iterations),
        seed=options.seed,
        rendering=RenderOptions(background=options.background),
    )
    fitted = fit(start, views, options=fit_options, control=control, progress=progress, checkpoint=checkpoint)
    return fitted.with_sh_degree(options.sh_degree)


@dataclass(frozen=True)
class _Control:
    """What happens between the steps: the density, and one more band of colour every `band_every` steps."""

    sh_degree: int
    band_every: int
    density: Density

    def __call__(self, state: FitState, step: Step) -> FitState:
        state = self.density.after(state, step)
        degree = min(self.sh_degree, state.iteration // self.band_every)
        if degree <= state.gaussians.sh_degree:
            return state
        wider = state.gaussians.with_sh_degree(degree)
        return replace(state, gaussians=wider, moments=state.moments.padded("sh", wider.sh.shape[1]))


def _start(capture: PosedImages, options: ReconstructOptions, progress: Progress) -> Gaussians:
    points, colors = capture.points, capture.point_colors
    if len(points) < _FEWEST_POINTS:
        count = max(options.most_gaussians // 4, 1)
        found = f"{len(points)} sparse points" if len(points) else "no sparse points"
        progress(0, options.all_iterations, f"{found}: starting from {count} random ones where the cameras look")
        points = random_points(capture.cameras, count=count, seed=options.seed)
        colors = torch.rand(count, 3, generator=torch.Generator().manual_seed(options.seed))
    opacity = _PUBLISHED_OPACITY if options.all_iterations >= PUBLISHED_ITERATIONS else _SHORT_RUN_OPACITY
    start = from_points(points, colors, count=options.most_gaussians, seed=options.seed)
    return replace(start, opacity_logits=torch.full_like(start.opacity_logits, opacity).logit())


def _density(options: ReconstructOptions, first_count: int, cameras: Cameras) -> Density:
    n = options.all_iterations
    return Density(
        budget=options.most_gaussians,
        first_count=first_count,
        every=max(1, min(100, n // 20)),
        full_at=int(0.6 * n),
        stop=int(0.8 * n),
        camera_centers=cameras.centers.to(options.device),
    )


def _rates(cameras: Cameras, iterations: int) -> Rates:
    extent = scene_extent(cameras)
    shorter = max(1.0, PUBLISHED_ITERATIONS / iterations)
    farther, faster = min(4.0, shorter**0.5), min(8.0, shorter**0.6)
    return Rates(
        means=1.6e-4 * extent * farther,
        means_final=1.6e-6 * extent * farther,
        log_scales=0.005 * faster,
        quaternions=0.001 * faster,
        opacity_logits=0.025 * faster,
        sh=0.0025 * faster,
        sh_higher=0.0025 / 20 * faster,
        final=0.1 if shorter > 1 else 1.0,
    )
