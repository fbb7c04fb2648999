"""The command `synth pairs`: training pairs of objects in scenes, rendered with Blender."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from splatgraft.project.folder_lock import locked
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.runtime.workers import Task
from splatgraft_paper.synthesis import pairs
from splatgraft_paper.synthesis.jobs import render_job
from splatgraft_paper.synthesis.outdoors import SUPPLIED_MAPS
from splatgraft_paper.synthesis.rendered_data import RenderWorkers, check_pairs, read_render_size

_MAPS = (".hdr", ".exr")
_MODELS = (".glb", ".gltf", ".obj", ".blend")


@dataclass(frozen=True)
class SynthPairs:
    """Render training pairs for a harmoniser; a killed run is continued."""

    out: Positional
    """Folder for one folder per scene, manifest.jsonl and, where something failed, failures.txt."""
    scenes: int = 60
    """Number of scenes; each gives 5 cameras x objects x lights pairs."""
    first: int = 0
    """Number of the first scene, so that several machines can share the work without Ray."""
    size: str = "704x496"
    """Pixels of a picture, WIDTHxHEIGHT."""
    samples: int = 128
    """Light paths per pixel; with the denoiser 16 are enough for small sizes."""
    objects: int = 2
    """Per scene; the background is rendered once for all."""
    lights: int = 3
    """Environment maps per object."""
    seed: int = 0
    """Of all random choices."""
    maps: Path | None = None
    """Folder with .hdr and .exr environment maps; those that come with Blender where not given."""
    models: Path | None = None
    """Folder with .glb, .gltf, .obj and .blend models that alternate with generated objects."""
    workers: RenderWorkers = field(default_factory=RenderWorkers)

    def execute(self, console: Console) -> int:
        """Render what is missing, check everything; 1 where a scene failed or a pair is faulty."""
        plan = pairs.PairPlan(
            scenes=self.scenes,
            objects=self.objects,
            lights=self.lights,
            seed=self.seed,
            size=read_render_size(self.size, self.samples),
            maps=_files(self.maps, _MAPS, "--maps") or SUPPLIED_MAPS,
            models=_files(self.models, _MODELS, "--models"),
        )
        python = self.workers.python(console)
        with locked(self.out):
            tasks, folders, failures = [], [], []
            for number in range(self.first, self.first + self.scenes):
                try:
                    job = pairs.plan(plan, number)
                except ValueError as error:
                    failures.append(f"scene {number}: {error}")
                    continue
                folders.append(self.out / pairs.job_folder_name(job))
                tasks.append(Task(folders[-1].name, partial(render_job, job, folders[-1], python)))
            failures += self.workers.run(tasks, console)
            return check_pairs(self.out, failures, console)


def _files(folder: Path | None, suffixes: tuple[str, ...], option: str) -> tuple[str, ...]:
    if folder is None:
        return ()
    found = sorted(str(path.resolve()) for path in folder.rglob("*") if path.suffix.lower() in suffixes)
    if not found:
        raise ValueError(f"{option} {folder}: expected files that end in {', '.join(suffixes)}, found none")
    return tuple(found)


COMMAND = SynthPairs
