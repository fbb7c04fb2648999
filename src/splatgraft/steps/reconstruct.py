"""The command `reconstruct`: train a scene.ply on a capture folder."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from splatgraft.capture import readable_views, require_coverage
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.image_metrics import fit_color, psnr, ssim
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.folders.capture_files import capture_inputs, exposure_notes, left_out_notes
from splatgraft.formats import read_capture, write_gaussians
from splatgraft.project.layout import METRICS_FILE, SCENE_FILE
from splatgraft.project.record import read_record
from splatgraft.project.step import Context, Inputs, Positional, choose_device
from splatgraft.reconstruction import (
    ReconstructOptions,
    describe_duration,
    predict_cpu_seconds,
    predict_memory,
    reconstruct,
)
from splatgraft.rendering import RenderOptions, render
from splatgraft.runtime.note import Note

EVAL_EVERY = 8
"""Interval of held-out views, as in 3DGS."""


@dataclass(frozen=True)
class Reconstruct:
    """Train a 3DGS scene on posed images."""

    remedy: ClassVar[str] = "leave the named photos out, or lock exposure and photograph again: splatgraft check PHOTOS"

    capture: Positional
    """A COLMAP folder, a folder with transforms.json, or the result of `splatgraft capture`."""
    out: Path = Path("scene")
    """Folder for scene.ply."""
    eval: bool = False
    """Hold out every 8th view and measure how well the scene predicts it; the same as --eval-every 8."""
    options: ReconstructOptions = field(default_factory=lambda: ReconstructOptions(device="auto"))

    def inputs(self) -> Inputs:
        """Return the files of the capture, without masks."""
        return capture_inputs(self.capture, read_capture(self.capture))

    def write(self, folder: Path, context: Context) -> None:
        """Write scene.ply, and metrics.json if views are held out."""
        capture = readable_views(read_capture(self.capture), progress=context.progress)
        context.console.tell(*left_out_notes(self.capture, len(capture), capture.left_out))
        require_coverage(capture, str(self.capture))
        device = choose_device(self.options.device, context.console)
        options = replace(self.options, device=str(device))
        if self.eval and not options.eval_every:
            options = replace(options, eval_every=EVAL_EVERY)
        context.console.say(f"memory: at most about {predict_memory(capture, options) / 2**30:.1f} GiB")
        if device.type == "cpu":
            threads = torch.get_num_threads()
            seconds = predict_cpu_seconds(capture.cameras, options) / threads
            context.console.say(f"time: about {describe_duration(seconds)} on {threads} idle cores, half or twice that")
        warnings = exposure_notes(self.capture, capture.image_paths)
        if read_record(self.capture) is None:  # the command `capture` has printed them already
            context.console.tell(*warnings)
        if options.photo_colors is None:
            options = replace(options, photo_colors=bool(warnings))
            if warnings:
                context.console.say("exposure and white balance are fitted for each photo (photo_colors)")
        scene = reconstruct(capture, options, progress=context.progress, checkpoint=context.checkpoint)
        write_gaussians(folder / SCENE_FILE, scene.to("cpu"))
        if options.eval_every:
            metrics = _held_out_metrics(scene, options.served(capture), options)
            context.console.say(
                f"held out: {metrics['psnr']:.2f} dB as photographed, {metrics['psnr_color_fitted']:.2f} dB with the "
                f"colours of each view fitted, SSIM {metrics['ssim']:.4f}"
            )
            photo_of = dict(zip(capture.cameras.names, capture.image_paths, strict=True))
            for name, text in far_worse(metrics["psnr_by_view"]).items():
                context.console.tell(Note(text, "warning", picture=photo_of[name]))
            (folder / METRICS_FILE).write_text(json.dumps(metrics, indent=1), encoding="utf-8")


def far_worse(psnr_by_view: dict[str, float]) -> dict[str, str]:
    """Describe each held-out view far worse than the rest, by photo, the worst first; `psnr_by_view` is in dB."""
    values = np.array(list(psnr_by_view.values()))
    middle = float(np.median(values))
    deviation = 1.4826 * float(np.median(np.abs(values - middle)))  # robust standard deviation
    limit = middle - max(3 * deviation, 3.0)  # the usual three deviations, and at least twice the squared error
    return {
        name: f"held out: {name} is far worse than the rest: {value:.1f} dB, median {middle:.1f} dB; its pose may be "
        f"wrong, or the photo blurred"
        for name, value in sorted(psnr_by_view.items(), key=lambda item: item[1])
        if value < limit
    }


def _held_out_metrics(scene: Gaussians, capture: PosedImages, options: ReconstructOptions) -> dict[str, Any]:
    """Measure the held-out views: means over them, and the PSNR of each.

    `psnr` and `ssim` compare with the photos; for `psnr_color_fitted`, exposure and white balance are fitted first.
    """
    views = capture.select(held_out(len(capture), options.eval_every))
    values: list[tuple[float, float, float]] = []
    for index, camera in enumerate(views.cameras.to(scene.device)):
        picture = render(scene, camera, options=RenderOptions(background=options.background)).color
        image, truth = picture[0].cpu().clamp(0, 1), views.image(index)
        fitted = fit_color(image, truth)
        values.append((float(psnr(image, truth)), float(ssim(image, truth)), float(psnr(fitted, truth))))
    means = [sum(column) / len(values) for column in zip(*values, strict=True)]
    by_view = dict(zip(views.cameras.names, (value for value, *_ in values), strict=True))
    return {
        "psnr": means[0],
        "psnr_color_fitted": means[2],
        "ssim": means[1],
        "views": len(values),
        "gaussians": scene.count,
        "psnr_by_view": by_view,
    }


COMMAND = Reconstruct
