"""The command `paper consolidate`: the paper's consolidation, with iterative updates of the views."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.consolidation import ImageSequence, consolidate
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import read_rgb, stored_size
from splatgraft.fitting import l1_dssim
from splatgraft.fitting.perceptual_losses import ImageLoss, lpips_vgg, windowed_fourier
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.harmonization import (
    HARMONIZERS,
    Harmonizer,
    HarmonizerContext,
    HarmonizerInputs,
    HarmonizerOptions,
    make_harmonizer,
)
from splatgraft.project.layout import SCENE_FILE
from splatgraft.project.record import STEP_FILE, read_record
from splatgraft.project.step import Context, choose_device
from splatgraft.rendering import RenderOptions, render
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft.runtime.progress import NoCheckpoint
from splatgraft.runtime.settings import Table, from_table
from splatgraft.steps import consolidate as tool
from splatgraft_paper.consolidation import NoisyStartHarmonizer, PaperDescent, Schedule, descend_as_paper, noise_levels
from splatgraft_paper.tables.harmonize_pictures import keep_pictures

UPDATES_FOLDER = "updates"


@dataclass(frozen=True)
class Consolidate(tool.Consolidate):
    """Fit the colours of a scene to harmonised views by the paper's descent, with iterative updates of the views."""

    method: Literal["paper", "fast"] = "paper"
    """paper: steps of Adam on LPIPS (its Sec. 6). fast: the normal equations and short descent of `consolidate`."""
    loss: Literal["fourier", "l1-dssim", "lpips"] | None = None
    """Loss of the descent: windowed Fourier magnitudes, that of 3DGS, or LPIPS (VGG; needs its weights); by default
    lpips for paper and fourier for fast."""
    updates: int = 1
    """Number of harmonisations. After the first the views are harmonised again, by the method that made `images`, from
    renders of the scene so far (paper, Iterative Dataset Update). updates/ has the scene and the views of each."""
    schedule: Schedule = "linear"
    """Noise of the updates, from 1 to 0.1 by equal differences or by equal ratios."""
    iterations: int = 10_000
    """Steps of paper; each update after the first has a fifth of them."""
    lpips_weights: Path | None = None
    """Folder with vgg16-397923af.pth and vgg.pth; torch hub's cache by default."""

    def write(self, folder: Path, context: Context) -> None:
        """Make scene.ply."""
        if self.updates < 1:
            raise ValueError(f"consolidate: expected updates of at least 1, found {self.updates}")
        device = choose_device(self.device, context.console)
        views = ViewFolder.open(self.views)
        cameras, loss = views.cameras.to(device), self.image_loss()
        harmonizer = self._noisy_harmonizer(views, device, context.console.say) if self.updates > 1 else None
        images = self.read_images(views, device)
        descent = PaperDescent(loss, self.iterations, rendering=RenderOptions(low_pass=self.low_pass))
        options = replace(self.options(), loss=loss)

        def fit(scene: Gaussians, images: ImageSequence, *, again: bool) -> Gaussians:
            if self.method == "fast":
                return consolidate(scene, cameras, images, options, progress=context.progress)
            # a fifth fits the times of the paper's Table 4: 5 x 12.5 minutes for the views, 3 for 10,000 steps, 4 x 0.6
            settings = replace(descent, iterations=max(1, self.iterations // 5), continued=True) if again else descent
            kept = NoCheckpoint() if again else context.checkpoint
            services = {"progress": context.progress, "checkpoint": kept}
            return descend_as_paper(scene, cameras, images, settings, **services)

        scene = read_gaussians(self.scene).to(device)
        # a killed run continues with the next view of the update at which it was
        kept = context.checkpoint.folder / UPDATES_FOLDER
        for number, strength in enumerate(noise_levels(self.schedule, self.updates)):
            update = kept / str(number)
            if harmonizer is not None and number:
                shown = _views_of(scene, views, cameras, descent.rendering)
                noisy = _FromNoise(harmonizer, strength)
                make = partial(_again, shown, noisy)
                made = keep_pictures(update / "images", views.stems, make, context.progress)
                images = LazySequence(len(made), lambda index, made=made: read_rgb(made[index]).to(device))
            scene = _kept_scene(update, device, partial(fit, scene, images, again=number > 0))
        if self.updates > 1:
            shutil.copytree(kept, folder / UPDATES_FOLDER)
        write_gaussians(folder / SCENE_FILE, scene.to("cpu"))

    def image_loss(self) -> ImageLoss:
        """Return the loss of the descent."""
        kind = self.loss or ("lpips" if self.method == "paper" else "fourier")
        if kind == "lpips":
            return lpips_vgg(self.lpips_weights)
        return windowed_fourier if kind == "fourier" else l1_dssim

    def harmonizer_options(self) -> HarmonizerOptions:
        """Read the method that made `images` from their step.json."""
        record = read_record(self.images)
        if record is None or record.options.get("method") not in HARMONIZERS:
            found = "none" if record is None else record.options.get("method")
            known = ", ".join(sorted(HARMONIZERS))
            raise ValueError(f"{self.images / STEP_FILE}: expected a method of {known} for updates, found {found}")
        kind = HARMONIZERS[record.options["method"]]
        values = {name: value for name, value in record.options.items() if name != "method" and value is not None}
        return from_table(kind, Table(values, str(self.images / STEP_FILE), self.images), {})

    def _noisy_harmonizer(self, views: ViewFolder, device: torch.device, say: Callable[[str], None]) -> Harmonizer:
        options = self.harmonizer_options()
        width, height = stored_size(views.path("composite", 0))
        count, strengths = len(views) * (self.updates - 1), noise_levels(self.schedule, self.updates)
        harmonizer = make_harmonizer(options, HarmonizerContext(device, count, width * height, strengths, say))
        if not isinstance(harmonizer, NoisyStartHarmonizer):
            say(f"{options.name}: no noise; each of {self.updates} updates begins at renders of the scene so far")
        return harmonizer


@dataclass(frozen=True)
class _FromNoise:
    """Harmoniser that starts from the view's prior at a noise level, if the model has noise."""

    harmonizer: Harmonizer
    strength: float

    def harmonize(self, view: HarmonizerInputs) -> Float[Tensor, "h w 3"]:
        """Harmonise one view."""
        if isinstance(self.harmonizer, NoisyStartHarmonizer):
            return self.harmonizer.harmonize_from(view, self.strength)
        return self.harmonizer.harmonize(view)


def _again(shown: Sequence[HarmonizerInputs], noisy: Harmonizer, index: int) -> Float[Tensor, "h w 3"]:
    return noisy.harmonize(shown[index])


def _kept_scene(folder: Path, device: torch.device, make: Callable[[], Gaussians]) -> Gaussians:
    """Read the scene of an update that an earlier run finished, or make and keep it."""
    path = folder / SCENE_FILE
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_gaussians(path, make().to("cpu"))
    return read_gaussians(path).to(device)


def _views_of(
    scene: Gaussians, views: ViewFolder, cameras: Cameras, options: RenderOptions
) -> Sequence[HarmonizerInputs]:
    """Read the views with a render of `scene` as their prior; the composite stays the condition."""

    @torch.no_grad()
    def view(index: int) -> HarmonizerInputs:
        picture = render(scene, cameras[index], options=options).color[0].cpu().clamp(0, 1)
        return replace(views.read(index), prior=picture)

    return LazySequence(len(views), view)
