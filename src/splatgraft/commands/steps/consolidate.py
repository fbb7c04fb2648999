"""The command `consolidate`: the colours of a scene are fitted to harmonised views."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatgraft.consolidation import ConsolidateOptions, consolidate
from splatgraft.core.images import read_mask, read_rgb
from splatgraft.fitting import l1_dssim
from splatgraft.fitting.perceptual_losses import ImageLoss, lpips_and_l1, lpips_vgg, windowed_fourier
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.project.layout import SCENE_FILE
from splatgraft.project.step import Context, Device, Inputs, choose_device
from splatgraft.rendering import RenderOptions
from splatgraft.runtime.lazy_sequence import LazySequence


@dataclass(frozen=True)
class Consolidate:
    """Fit the colours of a scene (all SH bands) to harmonised views; geometry and opacity stay."""

    scene: Path
    """The composite, or the relit composite, a .ply."""
    views: Path
    """The folder that `splatgraft render` wrote: its cameras."""
    images: Path
    """The folder that `splatgraft harmonize` wrote: images/, and confidence/ where there is one."""
    out: Path = Path("result")
    """Folder for scene.ply."""
    method: Literal["fast", "adam"] = "fast"
    """fast: normal equations, then a short gradient descent. adam: the paper's gradient descent from the start."""
    loss: Literal["fourier", "l1-dssim", "lpips", "lpips-l1"] = "fourier"
    """Loss of the gradient descent: windowed Fourier magnitudes, that of 3DGS, LPIPS (VGG; needs its weights), or LPIPS
    and L1, the paper's."""
    nuisance: Literal["tint-flow", "none"] = "tint-flow"
    """Errors of each single view that are solved for together with the colours (fast only)."""
    iterations: int = 10_000
    """Steps of adam."""
    passes: int = 12
    """Passes of the gradient descent of fast over all views."""
    lpips_weights: Path | None = None
    """Folder with vgg16-397923af.pth and vgg.pth; torch hub's cache where not given."""
    low_pass: Literal["classic", "antialiased"] = "classic"
    """As the scene was trained: `antialiased` for mip-splatting and for gsplat's antialiased mode."""
    device: Device = "auto"
    """Where to compute."""

    def inputs(self) -> Inputs:
        """The scene, the cameras and the harmonised images."""
        views = ViewFolder.open(self.views)
        images = (*self._images(views), *self._confidence_images(views))
        return {"scene": (self.scene,), "cameras": views.files()[:1], "images": images}

    def write(self, folder: Path, context: Context) -> None:
        """Make scene.ply."""
        device = choose_device(self.device, context.console)
        views = ViewFolder.open(self.views)
        images, confidence = self._images(views), self._confidence_images(views)
        scene = consolidate(
            read_gaussians(self.scene).to(device),
            views.cameras.to(device),
            LazySequence(len(images), lambda index: read_rgb(images[index]).to(device)),
            self._options(),
            weights=LazySequence(len(confidence), lambda index: read_mask(confidence[index]).to(device))
            if confidence
            else None,
            progress=context.progress,
            checkpoint=context.checkpoint,
        )
        write_gaussians(folder / SCENE_FILE, scene.to("cpu"))

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
        if self.loss == "lpips":
            return lpips_vgg(self.lpips_weights)
        if self.loss == "lpips-l1":
            return lpips_and_l1(self.lpips_weights)
        return windowed_fourier if self.loss == "fourier" else l1_dssim

    def _images(self, views: ViewFolder) -> tuple[Path, ...]:
        return tuple(self.images / "images" / f"{stem}.png" for stem in views.stems)

    def _confidence_images(self, views: ViewFolder) -> tuple[Path, ...]:
        folder = self.images / "confidence"
        return tuple(folder / f"{stem}.png" for stem in views.stems) if folder.is_dir() else ()


COMMAND = Consolidate
