"""The command `consolidate`: fit the colours of a scene to harmonised views."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch

from splatgraft.consolidation import ConsolidateOptions, consolidate
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import read_mask, read_rgb, stored_size
from splatgraft.fitting import l1_dssim
from splatgraft.fitting.perceptual_losses import ImageLoss, lpips_vgg, windowed_fourier
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.harmonization import (
    HARMONIZERS,
    Harmonized,
    Harmonizer,
    HarmonizerContext,
    HarmonizerInputs,
    HarmonizerOptions,
    NoisyStartHarmonizer,
    harmonize,
    make_harmonizer,
)
from splatgraft.harmonization.interface import noise_levels
from splatgraft.project.layout import SCENE_FILE
from splatgraft.project.record import STEP_FILE, read_record
from splatgraft.project.step import Context, Device, Inputs, choose_device
from splatgraft.rendering import RenderOptions, render
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft.runtime.settings import Table, from_table


@dataclass(frozen=True)
class Consolidate:
    """Fit the colours of a scene (all SH bands) to harmonised views; geometry and opacity stay fixed."""

    scene: Path
    """The composite, or the relit composite, a .ply."""
    views: Path
    """The folder that `splatgraft render` wrote; gives the cameras."""
    images: Path
    """The folder that `splatgraft harmonize` wrote: images/, and confidence/ if there is one."""
    out: Path = Path("result")
    """Folder for scene.ply."""
    method: Literal["fast", "paper"] = "fast"
    """fast: normal equations, then a short gradient descent. paper: 10,000 steps of Adam on LPIPS (its Sec. 6)."""
    loss: Literal["fourier", "l1-dssim", "lpips"] | None = None
    """Loss of the gradient descent: windowed Fourier magnitudes, the loss of 3DGS, or LPIPS (VGG; needs its weights).
    If not given, fourier for fast and lpips for paper."""
    updates: int = 1
    """Number of harmonisations. The first are `images`; each further one uses the same method on renders of the current
    scene (paper, Iterative Dataset Update)."""
    schedule: Literal["linear", "geometric"] = "linear"
    """Noise levels of the updates, from 1 to 0.1 by equal differences or by equal ratios."""
    nuisance: Literal["tint-flow", "none"] = "tint-flow"
    """Errors of each single view, solved together with the colours (fast only)."""
    iterations: int = 10_000
    """Steps of method paper; each further update takes a fifth."""
    passes: int = 12
    """Passes of method fast over all views in its gradient descent."""
    lpips_weights: Path | None = None
    """Folder with vgg16-397923af.pth and vgg.pth; torch hub's cache if not given."""
    low_pass: Literal["classic", "antialiased"] = "classic"
    """Screen filter that the scene was trained with: `antialiased` for mip-splatting and gsplat's antialiased mode."""
    device: Device = "auto"
    """Device to compute on."""

    def inputs(self) -> Inputs:
        """Return the scene, the cameras and the harmonised images."""
        views = ViewFolder.open(self.views)
        images = (*self._images(views), *self._confidence_images(views))
        return {"scene": (self.scene,), "cameras": views.files()[:1], "images": images}

    def write(self, folder: Path, context: Context) -> None:
        """Write scene.ply."""
        if self.updates < 1:
            raise ValueError(f"consolidate: expected updates of at least 1, found {self.updates}")
        device = choose_device(self.device, context.console)
        views = ViewFolder.open(self.views)
        options, cameras = self._options(), views.cameras.to(device)
        harmonizer = self._noisy_harmonizer(views, device, context.console.say) if self.updates > 1 else None
        images, confidence = self._images(views), self._confidence_images(views)
        scene = consolidate(
            read_gaussians(self.scene).to(device),
            cameras,
            LazySequence(len(images), lambda index: read_rgb(images[index]).to(device)),
            options,
            weights=LazySequence(len(confidence), lambda index: read_mask(confidence[index]).to(device))
            if confidence
            else None,
            progress=context.progress,
            checkpoint=context.checkpoint,
        )
        if harmonizer is not None:
            # fits the times of the paper's Table 4: 5 x 12.5 minutes for the views, 3 for 10,000 steps, 4 x 0.6
            options = replace(options, iterations=max(1, self.iterations // 5), continued=True)
            for strength in noise_levels(self.schedule, self.updates)[1:]:
                shown = _views_of(scene, views, cameras, options.rendering)
                made = harmonize(shown, _FromNoise(harmonizer, strength), progress=context.progress)
                again = [image.to(device) for image in made.images]
                sure = made.confidence and [one.to(device) for one in made.confidence]
                scene = consolidate(scene, cameras, again, options, weights=sure or None, progress=context.progress)
        write_gaussians(folder / SCENE_FILE, scene.to("cpu"))

    def harmonizer_options(self) -> HarmonizerOptions:
        """Read the options of the method that made `images` from their step.json."""
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
            say(f"{options.name}: no noise levels; each of {self.updates} updates begins at renders of the scene")
        return harmonizer

    def _options(self) -> ConsolidateOptions:
        return ConsolidateOptions(
            method=self.method,
            loss=self._loss(),
            view_error=self.nuisance == "tint-flow",
            polish_passes=self.passes,
            iterations=self.iterations,
            rendering=RenderOptions(low_pass=self.low_pass),
        )

    def _loss(self) -> ImageLoss:
        kind = self.loss or ("lpips" if self.method == "paper" else "fourier")
        if kind == "lpips":
            return lpips_vgg(self.lpips_weights)
        return windowed_fourier if kind == "fourier" else l1_dssim

    def _images(self, views: ViewFolder) -> tuple[Path, ...]:
        return tuple(self.images / "images" / f"{stem}.png" for stem in views.stems)

    def _confidence_images(self, views: ViewFolder) -> tuple[Path, ...]:
        folder = self.images / "confidence"
        return tuple(folder / f"{stem}.png" for stem in views.stems) if folder.is_dir() else ()


@dataclass(frozen=True)
class _FromNoise:
    """A harmoniser that starts from the view's prior at a noise level, if it has noise levels."""

    harmonizer: Harmonizer
    strength: float

    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """Harmonise one view."""
        if isinstance(self.harmonizer, NoisyStartHarmonizer):
            return self.harmonizer.harmonize_from(view, self.strength)
        return self.harmonizer.harmonize(view)


def _views_of(
    scene: Gaussians, views: ViewFolder, cameras: Cameras, options: RenderOptions
) -> Sequence[HarmonizerInputs]:
    """Return the views with renders of `scene` as their priors; the composite stays the condition."""

    @torch.no_grad()
    def view(index: int) -> HarmonizerInputs:
        picture = render(scene, cameras[index], options=options).color[0].cpu().clamp(0, 1)
        return replace(views.read(index), prior=picture)

    return LazySequence(len(views), view)


COMMAND = Consolidate
