"""Examples for learning the light: a scene drawn, rendered, reconstructed, and its light estimated beside the truth."""

import json
import random
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock

import numpy as np
import torch

from splatgraft.consolidation import ConsolidateOptions, SolveOptions, consolidate
from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.formats import read_capture
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.relighting.light.estimate import EstimatedLight, NoLight, fit_light
from splatgraft.segmentation import segment
from splatgraft.synthesis.benchmark import BenchmarkScene, BenchmarkSize, draw_scene, gather_capture, plan
from splatgraft.synthesis.jobs import Job, render_job
from splatgraft.synthesis.light_mixtures import (
    GroupLight,
    draw_gains,
    exposed,
    mixed_light,
    mixed_picture,
    with_more_lamps,
)
from splatgraft.synthesis.pairs import KINDS
from splatgraft.synthesis.scene import Scene
from splatgraft.training.light_examples import LightExample, light_example, write_examples

_SEEDS = (2**33, 2**34)
"""Range of the seeds of scenes and objects: neither the benchmark's, nor an exam's, nor those of training pairs."""
_NEW, _OLD = "new", "old"
_RECOLOR = ConsolidateOptions(
    view_error=None, solve=SolveOptions(rounds=2, steps=4, band_ridges=(0.02,)), polish_passes=0, unchanged_below=0.0
)
"""Colours of a reconstruction under another light: the pictures agree exactly, so least squares suffice."""
_one_at_a_time = Lock()
"""Blender renders several scenes at once; reconstruction takes all cores for one."""


@dataclass(frozen=True)
class LightScene:
    """A drawn scene and how it is made an example of."""

    which: BenchmarkScene
    size: BenchmarkSize
    reconstruction: ReconstructOptions
    mixtures: int
    """Other lights of each place, mixed from the renders."""


@dataclass(frozen=True)
class _Capture:
    """One of a scene's two captures: what was rendered and what was reconstructed of it."""

    place: str
    """`old` or `new`."""
    scene: Scene
    rendered: Path
    """Folder of the pictures."""
    probe: Path
    """Folder of the true light."""
    cameras: Cameras
    gaussians: Gaussians
    """Those of the object last."""
    object_count: int

    def parts(self, gaussians: Gaussians) -> tuple[Gaussians, Gaussians | None]:
        """The surroundings and the object of Gaussians in the order of `gaussians`."""
        count = gaussians.count - self.object_count
        whole = torch.arange(gaussians.count)
        return gaussians.select(whole < count), gaussians.select(whole >= count) if self.object_count else None


def draw_light_scene(seed: int, number: int, size: BenchmarkSize) -> BenchmarkScene:
    """Draw a scene; the kinds follow each other."""
    rng, kind = random.Random(f"lights-{seed}-{number}"), KINDS[number % len(KINDS)]
    return draw_scene(rng, f"{seed}_{number:05d}_{kind}", kind, _SEEDS, size)


def make_light_examples(scene: LightScene, work: Path, out: Path, blender_python: Path) -> None:
    """Make the examples of both places of a scene: with the object on its pedestal, and without it at its new place.

    Args:
        scene: The scene.
        work: Receives the pictures; is removed at the end.
        out: The .npz to write.
        blender_python: A Python with bpy.

    Raises:
        ValueError: Blender fails, or there is no light at a place.
    """
    if out.is_file():
        return
    target, source = (_by_lamp(job, scene) for job in plan(scene.which, scene.size))
    for name, job in (("target", target), ("source", source)):
        render_job(job, work / name, blender_python)
    gather_capture(work / "source", "source", work / "old", passes=("images", "masks"), points=True)
    gather_capture(work / "target", "target", work / "new", passes=("images",), points=True)
    with _one_at_a_time:
        examples = _examples(scene, (source.scene, target.scene), work)
    write_examples(out, examples)
    shutil.rmtree(work)


def _by_lamp(job: Job, scene: LightScene) -> Job:
    """With more lamps, each rendered alone too, and without the pictures and points that only an evaluation needs."""
    takes = [take for take in job.takes if take.name not in ("ground_truth", "surface")]
    if not scene.mixtures:
        return replace(job, takes=tuple(takes))
    by_lamp = tuple(replace(take, passes=(*take.passes, "groups")) for take in takes)
    lit = with_more_lamps(job.scene, random.Random(f"lamps-{scene.which.name}-{job.scene.kind}"))
    return replace(job, scene=lit, takes=by_lamp)


def _examples(scene: LightScene, drawn: tuple[Scene, Scene], work: Path) -> list[LightExample]:
    old, new = read_capture(work / "old"), read_capture(work / "new")
    cut = segment(reconstruct(old, scene.reconstruction), old)
    # the object stands at the same place of both worlds
    place = bounding_sphere(cut.object)
    target = reconstruct(new, scene.reconstruction)
    degree = max(cut.surroundings.sh_degree, cut.object.sh_degree)
    whole = concatenate([cut.surroundings.with_sh_degree(degree), cut.object.with_sh_degree(degree)])
    source = work / "source"
    captures = [
        _Capture(_OLD, drawn[0], source / "source", source / "old_light", old.cameras, whole, cut.object.count),
        _Capture(_NEW, drawn[1], work / "target" / "target", work / "target" / "light", new.cameras, target, 0),
    ]
    return [example for capture in captures for example in _of_capture(scene, capture, place)]


def _of_capture(scene: LightScene, capture: _Capture, place: BoundingSphere) -> Iterator[LightExample]:
    """Under the light that was drawn, then under mixtures."""
    name = f"{scene.which.name}/{capture.place}"
    panorama = torch.from_numpy(np.load(capture.probe / "0000.npy", allow_pickle=False)).float()
    suns = json.loads((capture.probe / "suns.json").read_text())
    found = _estimate(name, capture, capture.gaussians, place)
    yield light_example(name, found, panorama.sum(0) if scene.mixtures else panorama, suns)
    groups = json.loads((capture.rendered.parent / "light_groups.json").read_text()) if scene.mixtures else []
    if len(groups) < 2:
        # one lamp: another strength is another exposure
        return
    light, rng = GroupLight(panorama, tuple(suns)), random.Random(f"mixtures-{name}")
    files = [capture.rendered / f"{i:04d}_groups.npy" for i in range(len(capture.cameras))]
    pictures = [torch.from_numpy(np.load(file, allow_pickle=False)) for file in files]
    for number in range(scene.mixtures):
        gains = exposed(draw_gains(capture.scene, rng), pictures[:: max(1, len(pictures) // 3)], rng)
        colors = [mixed_picture(gains, picture) for picture in pictures]
        mixed = f"{name}{number + 1}"
        recolored = consolidate(capture.gaussians, capture.cameras, colors, _RECOLOR)
        yield light_example(mixed, _estimate(mixed, capture, recolored, place), *mixed_light(gains, light, groups))


def _estimate(name: str, capture: _Capture, gaussians: Gaussians, place: BoundingSphere) -> EstimatedLight:
    surroundings, thing = capture.parts(gaussians)
    found = fit_light(surroundings, place, capture.cameras, object_gaussians=thing)
    if isinstance(found, NoLight):
        raise ValueError(f"{name}: expected light, found none: {found.reason}")
    return found
