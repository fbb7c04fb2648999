"""One scene of an exam in memory: its composite, its held-out views, and what is true of its light and its object."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from exam.measure_light import nearest_normals, seen_surface
from splatgraft.core.cameras import Cameras
from splatgraft.core.composite import Composite
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.posed_images import held_out
from splatgraft.evaluation import Truth
from splatgraft.folders.composite_folder import read_composite
from splatgraft.formats import read_cameras, read_capture, read_gaussians
from splatgraft.project.layout import PLACEMENT_FILE
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.relighting import Light, SourceScene
from splatgraft.rendering import render
from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark.measure_method import true_view
from splatgraft_paper.benchmark.scene import HELD_OUT_EVERY, GroundTruthScene, compose_scene
from splatgraft_paper.benchmark.true_light import light_from_probe


@dataclass(frozen=True)
class TrueView:
    """One view of the target with what is true of it."""

    camera: Cameras
    truth: Truth
    background: Float[Tensor, "h w 3"]
    """The reconstructed target without the object, sRGB in [0, 1]."""

    def picture(self, scene: Gaussians) -> Float[Tensor, "h w 3"]:
        """A scene from this view, sRGB in [0, 1]."""
        return render(scene, self.camera).color[0].clamp(0, 1)


@dataclass(frozen=True)
class ExamScene:
    """One scene with what is true of it; n Gaussians of the object."""

    name: str
    composite: Composite
    cameras: Cameras
    """The target's, without the held-out ones."""
    source: SourceScene
    """The source without the object; nothing is told."""
    views: tuple[TrueView, ...]
    """Held out: nothing was fitted to them."""
    fitted_views: tuple[TrueView, ...]
    """Those of `cameras`, whose pictures without the object the target was fitted to."""
    new_light: Light
    """True, at the object's place in the target, target's frame."""
    old_light: Light
    """True, at its place in the source, source's frame."""
    normals: Float[Tensor, "n 3"] | None
    """True, of the object's Gaussians, source's frame; None where the object's surface is not known."""


def read_scene(folder: Path, work: Path, options: ReconstructOptions, console: Console) -> ExamScene:
    """Reconstruct and compose a rendered scene where that is not done yet, and read it.

    Args:
        folder: As `render_scene` leaves it; without surface.npy no normals are known.
        work: Receives both reconstructions, the object and the composite.
        options: Of both reconstructions.
        console: Takes progress.

    Raises:
        ValueError: A file is missing or damaged.
    """
    files = GroundTruthScene.from_folder(folder)
    composed = compose_scene(files, work, options, device="cpu", console=console)
    composite = read_composite(composed.target, composed.composite / PLACEMENT_FILE)
    assert composed.surroundings is not None
    assert composed.source_cameras is not None
    source = SourceScene(read_gaussians(composed.surroundings), read_cameras(composed.source_cameras))
    return ExamScene(
        name=folder.name,
        composite=composite,
        cameras=read_cameras(composed.cameras),
        source=source,
        views=_true_views(files, composite.target, are_held_out=True),
        fitted_views=_true_views(files, composite.target, are_held_out=False),
        new_light=_read_light(true_light_files(folder)["new"]),
        old_light=_read_light(true_light_files(folder)["old"]),
        normals=_read_normals(folder / "surface.npy", composite.objects[0].gaussians, source.cameras),
    )


def _true_views(files: GroundTruthScene, target: Gaussians, *, are_held_out: bool) -> tuple[TrueView, ...]:
    truth, photographs = read_capture(files.truth), read_capture(files.target)
    views = []
    chosen = held_out(len(truth), HELD_OUT_EVERY) == are_held_out
    for index in torch.nonzero(chosen).flatten().tolist():
        camera = truth.cameras[index]
        background = render(target, camera).color[0].clamp(0, 1)
        views.append(TrueView(camera, true_view(truth, photographs, index), background))
    return tuple(views)


def true_light_files(folder: Path) -> dict[str, tuple[Path, Path]]:
    """Panorama and suns of the `new` and the `old` place in a rendered scene's folder."""
    old = folder / "old_light"
    return {"new": (folder / "probe.npy", folder / "suns.json"), "old": (old / "0000.npy", old / "suns.json")}


def read_probe(panorama: Path, suns: Path) -> tuple[Float[Tensor, "h w 3"], list[dict[str, Any]]]:
    """True light at a place: an equirectangular panorama without the suns, linear, and the entries of suns.json.

    Raises:
        ValueError: A file is missing or damaged.
    """
    try:
        return torch.from_numpy(np.load(panorama, allow_pickle=False)).float(), json.loads(suns.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{panorama}, {suns.name}: expected a true light, found {error}") from error


def _read_light(where: tuple[Path, Path]) -> Light:
    probe = read_probe(*where)
    try:
        return light_from_probe(*probe)
    except ValueError as error:
        raise ValueError(f"{where[0]}, {where[1].name}: expected a true light, found {error}") from error


def _read_normals(path: Path, thing: Gaussians, cameras: Cameras) -> Float[Tensor, "n 3"] | None:
    if not path.is_file():
        return None
    surface = torch.from_numpy(np.load(path, allow_pickle=False)).float()
    return nearest_normals(thing.means, seen_surface(surface, cameras))
