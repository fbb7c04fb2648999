"""Examples for learning the light: a scene drawn, rendered, reconstructed, and its light estimated beside the truth."""

import json
import random
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock

import numpy as np
import torch

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats import read_capture
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.relighting.light.estimate import NoLight, fit_light
from splatgraft.segmentation import segment
from splatgraft.synthesis.benchmark import BenchmarkScene, BenchmarkSize, draw_scene, gather_capture, plan
from splatgraft.synthesis.jobs import Job, render_job
from splatgraft.synthesis.pairs import KINDS
from splatgraft.training.light_examples import LightExample, light_example, write_examples

_SEEDS = (2**33, 2**34)
"""Range of the seeds of scenes and objects: neither the benchmark's, nor an exam's, nor those of training pairs."""
_NEW, _OLD = "new", "old"
_one_at_a_time = Lock()
"""Blender renders several scenes at once; reconstruction takes all cores for one."""


@dataclass(frozen=True)
class LightScene:
    """A drawn scene and how it is made an example of."""

    which: BenchmarkScene
    size: BenchmarkSize
    reconstruction: ReconstructOptions


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
    target, source = (_without_truth(job) for job in plan(scene.which, scene.size))
    for name, job in (("target", target), ("source", source)):
        render_job(job, work / name, blender_python)
    gather_capture(work / "source", "source", work / "old", passes=("images", "masks"), points=True)
    gather_capture(work / "target", "target", work / "new", passes=("images",), points=True)
    with _one_at_a_time:
        examples = _examples(scene, work)
    write_examples(out, examples)
    shutil.rmtree(work)


def _without_truth(job: Job) -> Job:
    """Without the pictures and points that only an evaluation needs."""
    return replace(job, takes=tuple(take for take in job.takes if take.name not in ("ground_truth", "surface")))


def _examples(scene: LightScene, work: Path) -> list[LightExample]:
    old, new = read_capture(work / "old"), read_capture(work / "new")
    cut = segment(reconstruct(old, scene.reconstruction), old)
    # the object stands at the same place of both worlds
    place = bounding_sphere(cut.object)
    target = reconstruct(new, scene.reconstruction)
    name = scene.which.name
    return [
        _example(f"{name}/{_OLD}", (cut.surroundings, cut.object), place, old.cameras, work / "source" / "old_light"),
        _example(f"{name}/{_NEW}", (target, None), place, new.cameras, work / "target" / "light"),
    ]


def _example(
    name: str, parts: tuple[Gaussians, Gaussians | None], place: BoundingSphere, cameras: Cameras, probe: Path
) -> LightExample:
    scene, thing = parts
    found = fit_light(scene, place, cameras, object_gaussians=thing)
    if isinstance(found, NoLight):
        raise ValueError(f"{name}: expected light, found none: {found.reason}")
    panorama = torch.from_numpy(np.load(probe / "0000.npy", allow_pickle=False)).float()
    return light_example(name, found, panorama, json.loads((probe / "suns.json").read_text()))
