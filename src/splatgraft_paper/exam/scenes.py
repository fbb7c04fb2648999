"""Scenes of the held-out benchmark: drawn from a number alone, rendered, reconstructed, and read with their truth."""

import random
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.composite import Composite
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
from splatgraft_paper.benchmark.scene import HELD_OUT_EVERY, GroundTruthScene, compose_scene
from splatgraft_paper.benchmark.true_light import TRUE_LIGHT_FILE, read_probe, write_true_light
from splatgraft_paper.peers.deferred_reflection import ReflectiveScene
from splatgraft_paper.synthesis.benchmark import BenchmarkScene, BenchmarkSize, find_defect, gather, plan
from splatgraft_paper.synthesis.jobs import RenderSize, render_job
from splatgraft_paper.synthesis.places import KINDS

_CELLS = 80  # width of the image in whose cells surface points are compared; the object takes up half of it or less
_BEHIND = 0.05  # share of the object's size by which a point may lie behind the nearest one and still count as seen
TRAINING_NUMBER = 0
"""Its scenes are for development; every other number is used for one exam only."""
SIZE = BenchmarkSize(RenderSize(width=288, height=204, samples=8), views=18)
_SEEDS = (2**31, 2**32)
"""Range of the seeds of scenes and objects. The benchmark's scenes have 9000001 and up, its objects 11 and up, the
development scenes 9100 to 9999; training pairs have 100003 x set + scene, and objects below 2**31."""


def draw_scenes(number: int, count: int) -> tuple[BenchmarkScene, ...]:
    """Draw the scenes of an exam: all kinds in turn, in an order drawn too, each with a seed and an object's seed.

    Seeds whose scene has no room for the cameras are drawn again. The first scenes do not depend on `count`.
    """
    rng = random.Random(f"exam-{number}")
    kinds = rng.sample(KINDS, len(KINDS))
    scenes: list[BenchmarkScene] = []
    while len(scenes) < count:
        kind = kinds[len(scenes) % len(kinds)]
        seeds = rng.randrange(*_SEEDS), rng.randrange(*_SEEDS)
        scene = BenchmarkScene(f"{len(scenes):02d}_{kind}", kind, *seeds)
        with suppress(ValueError):
            plan(scene, SIZE)
            scenes.append(scene)
    return tuple(scenes)


def render_scene(which: BenchmarkScene, out: Path, blender_python: Path, *, jobs: int) -> Path:
    """Render what is missing of a scene into renders/ and scenes/ of `out`; gives its folder."""
    folder = out / "scenes" / which.name
    if not (folder / TRUE_LIGHT_FILE).is_file():  # it is written last
        sides = [out / "renders" / f"{which.name}_{side}" for side in ("target", "source")]
        planned = zip(plan(which, SIZE), sides, strict=True)
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
    """One view of the target with what is true of it."""

    camera: Cameras
    truth: Truth
    background: Float[Tensor, "h w 3"]
    """The reconstructed target without the object, sRGB in [0, 1]."""

    @torch.no_grad()
    def picture(self, scene: Gaussians | ReflectiveScene) -> Float[Tensor, "h w 3"]:
        """A scene from this view, sRGB in [0, 1]."""
        if isinstance(scene, ReflectiveScene):
            return scene.picture(self.camera).clamp(0, 1)
        return render(scene, self.camera).color[0].clamp(0, 1)


@dataclass(frozen=True)
class ExamScene:
    """One scene with what is true of it; n Gaussians of the object."""

    name: str
    composite: Composite
    cameras: Cameras
    """The target's, without the held-out ones."""
    source: SourceScene
    """The source without the object, and without its true light."""
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
    photos: Mapping[str, PosedImages] = field(default_factory=dict)
    """Those that the `source` and the `target` were reconstructed from."""


def read_scene(folder: Path, work: Path, options: ReconstructOptions, console: Console) -> ExamScene:
    """Reconstruct and compose a rendered scene in `work` where that is not done yet, and read it."""
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
    """The surface points (position, unit normal) that some camera sees: not what lies inside of the object or under it.

    A point is seen where it faces the camera and no point in its cell of an image, of ten or more, is nearer by more
    than a share of the object's size.
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
    """The outward normal of the nearest of m surface points (position and unit normal) to each point."""
    nearest = KDTree(surface[:, :3].numpy()).query(points.numpy())[1]
    return surface[torch.from_numpy(nearest), 3:].contiguous()
