"""Scenes of the held-out benchmark: drawn from a number, rendered, reconstructed, and read with their truth."""

import random
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.compositing.composite import Composite
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.evaluation import Truth
from splatgraft.folders.composite_folder import read_composite
from splatgraft.formats import read_cameras, read_capture, read_gaussians
from splatgraft.project.layout import PLACEMENT_FILE
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.relighting import Light, SourceScene
from splatgraft.rendering import render
from splatgraft.runtime.console import Console
from splatgraft.runtime.workers import Task, run_tasks
from splatgraft_paper.benchmark.measure import true_view
from splatgraft_paper.benchmark.scene import HELD_OUT_EVERY, CompositionOptions, GroundTruthScene, compose_scene
from splatgraft_paper.benchmark.true_light import TRUE_LIGHT_FILE, read_probe, write_true_light
from splatgraft_paper.peers.deferred_reflection import ReflectiveScene
from splatgraft_paper.synthesis.benchmark import BenchmarkScene, BenchmarkSize, find_defect, gather, plan
from splatgraft_paper.synthesis.jobs import RenderSize, render_job
from splatgraft_paper.synthesis.places import KINDS

_CELLS = 80  # width and height of a coarse depth image of surface points; the object takes up half of it or less
_BEHIND = 0.05  # share of the object's size; points farther behind the nearest one of a cell are hidden
TRAINING_NUMBER = 0
"""Number whose scenes are for development; every other number is used for one exam only."""
SIZE = BenchmarkSize(RenderSize(width=288, height=204, samples=8), views=18)
# range of the seeds of scenes and objects. Other seeds are lower: benchmark scenes 9000001 and up, objects 11 and up;
# development scenes 9100 to 9999; training pairs 100003 x set + scene, objects below 2**31
_SEEDS = (2**31, 2**32)


def draw_scenes(
    number: int, count: int, kinds: Sequence[str] = KINDS, size: BenchmarkSize = SIZE
) -> tuple[BenchmarkScene, ...]:
    """Draw the scenes of an exam: `kinds` in turn, in random order, each with a seed of the scene and of the object.

    A seed is drawn again if its scene has no room for the cameras. The first scenes do not depend on `count`.
    """
    rng = random.Random(f"exam-{number}")
    kinds = rng.sample(kinds, len(kinds))
    scenes: list[BenchmarkScene] = []
    while len(scenes) < count:
        kind = kinds[len(scenes) % len(kinds)]
        seeds = rng.randrange(*_SEEDS), rng.randrange(*_SEEDS)
        scene = BenchmarkScene(f"{len(scenes):02d}_{kind}", kind, *seeds)
        with suppress(ValueError):
            plan(scene, size)
            scenes.append(scene)
    return tuple(scenes)


def render_scene(
    which: BenchmarkScene, out: Path, blender_python: Path, *, jobs: int, size: BenchmarkSize = SIZE
) -> Path:
    """Render the missing files of a scene into renders/ and scenes/ of `out`, and return its folder."""
    folder = out / "scenes" / which.name
    if not (folder / TRUE_LIGHT_FILE).is_file():  # this file is written last
        sides = [out / "renders" / f"{which.name}_{side}" for side in ("target", "source")]
        planned = zip(plan(which, size), sides, strict=True)
        tasks = [Task(side.name, partial(render_job, job, side, blender_python)) for job, side in planned]
        if failures := run_tasks(tasks, at_once=jobs):
            raise ValueError(failures[0])
        gather(which, sides[0], sides[1], folder)
        write_true_light(folder)
    if defect := find_defect(folder):
        raise ValueError(defect)
    return folder


@dataclass(frozen=True)
class TrueView:
    """One view of the target with its ground truth."""

    camera: Cameras
    truth: Truth
    background: Float[Tensor, "h w 3"]
    """Render of the reconstructed target without the object, sRGB in [0, 1]."""

    @torch.no_grad()
    def picture(self, scene: Gaussians | ReflectiveScene) -> Float[Tensor, "h w 3"]:
        """Render a scene from this view, sRGB in [0, 1]."""
        if isinstance(scene, ReflectiveScene):
            return scene.picture(self.camera).clamp(0, 1)
        return render(scene, self.camera).color[0].clamp(0, 1)


@dataclass(frozen=True)
class ExamScene:
    """One scene with its ground truth; the object has n Gaussians."""

    name: str
    composite: Composite
    cameras: Cameras
    """Cameras of the target, without the held-out ones."""
    source: SourceScene
    """Source without the object and without its true light."""
    views: tuple[TrueView, ...]
    """Held-out views, to which nothing was fitted."""
    fitted_views: tuple[TrueView, ...]
    """Views of `cameras`; the target was fitted to their pictures without the object."""
    new_light: Light
    """True light at the object's place in the target, target's frame."""
    old_light: Light
    """True light at the object's place in the source, source's frame."""
    normals: Float[Tensor, "n 3"] | None
    """True normals of the object's Gaussians, source's frame; None if the object's surface is not known."""
    photos: Mapping[str, PosedImages] = field(default_factory=dict)
    """Photos from which `source` and `target` were reconstructed."""


def read_scene(folder: Path, work: Path, options: ReconstructOptions, console: Console) -> ExamScene:
    """Read a rendered scene, after reconstructing and composing it in `work` if that is not done yet."""
    files = GroundTruthScene.from_folder(folder)
    composed = compose_scene(files, work, CompositionOptions(options, "cpu"), console)
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
        new_light=read_probe(folder / "probe.npy", folder / "suns.json"),
        old_light=read_probe(folder / "old_light" / "0000.npy", folder / "old_light" / "suns.json"),
        photos={side: read_capture(work / side / "capture") for side in ("source", "target")},
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


def _read_normals(path: Path, thing: Gaussians, cameras: Cameras) -> Float[Tensor, "n 3"] | None:
    if not path.is_file():
        return None
    surface = torch.from_numpy(np.load(path, allow_pickle=False)).float()
    return nearest_normals(thing.means, seen_surface(surface, cameras))


def seen_surface(surface: Float[Tensor, "m 6"], cameras: Cameras) -> Float[Tensor, "s 6"]:
    """Select the surface points (position, unit normal) that a camera sees, without those inside or under the object.

    A camera sees a point that faces it, unless a point in the same cell of a coarse depth image is much nearer.
    """
    points, normals = surface[:, :3], surface[:, 3:]
    middle, size = points.mean(0), float((points - points.mean(0)).norm(dim=1).max())
    seen = torch.zeros(len(points), dtype=torch.bool)
    for i in range(len(cameras)):
        pose = cameras.camera_from_world[i]
        depth = points @ pose[2, :3] + pose[2, 3]
        if float(depth.min()) <= 0:
            continue
        plane = (points @ pose[:2, :3].T + pose[:2, 3]) / depth[:, None]
        half = size / float(middle @ pose[2, :3] + pose[2, 3])
        cells = ((plane - plane.mean(0)) / half * _CELLS / 4 + _CELLS / 2).long().clamp(0, _CELLS - 1)
        index = cells[:, 1] * _CELLS + cells[:, 0]
        nearest = torch.full((_CELLS**2,), torch.inf).scatter_reduce(0, index, depth, "amin")
        facing = ((cameras.centers[i] - points) * normals).sum(1) > 0
        seen |= facing & (depth < nearest[index] + _BEHIND * size)
    return surface[seen]


def nearest_normals(points: Float[Tensor, "n 3"], surface: Float[Tensor, "m 6"]) -> Float[Tensor, "n 3"]:
    """Look up each point's outward normal at the nearest of m surface points (position and unit normal)."""
    nearest = KDTree(surface[:, :3].numpy()).query(points.numpy())[1]
    return surface[torch.from_numpy(nearest), 3:].contiguous()
