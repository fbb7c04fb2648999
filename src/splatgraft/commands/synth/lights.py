"""The command `synth lights`: examples for learning the light at a place from what captures show of it."""

from dataclasses import dataclass, field
from functools import partial

from splatgraft.project.folder_lock import locked
from splatgraft.project.step import Positional
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft.runtime.workers import Task
from splatgraft.synthesis.benchmark import BenchmarkSize
from splatgraft.workflow.light_examples import LightScene, draw_light_scene, make_light_examples
from splatgraft.workflow.rendered_data import RenderWorkers, read_render_size, write_failures

_BUDGET = 20_000


@dataclass(frozen=True)
class SynthLights:
    """Render scenes with Blender, reconstruct them, and keep what is known and what is true of their light.

    A scene gives two examples of 8 KB in two to three minutes of a core; its pictures are removed. A killed run is
    continued.
    """

    out: Positional
    """Folder for NUMBER.npz per scene and, where something failed, failures.txt."""
    scenes: int = 100
    """Number of scenes."""
    first: int = 0
    """Number of the first scene, so that several machines or days can share the work."""
    seed: int = 0
    """Of all random choices."""
    size: str = "288x204"
    """Pixels of a picture, WIDTHxHEIGHT; the light's estimate was fitted with such small ones."""
    views: int = 18
    """Of each of a scene's two captures."""
    samples: int = 8
    """Light paths per pixel."""
    mixtures: int = 8
    """Other lights of each place, mixed from the light of each lamp; 0 renders the scene's own light alone."""
    iterations: int = 1000
    """Of each reconstruction, with at most 20,000 Gaussians."""
    workers: RenderWorkers = field(default_factory=RenderWorkers)

    def execute(self, console: Console) -> int:
        """Make what is missing; 1 where a scene failed."""
        size = BenchmarkSize(read_render_size(self.size, self.samples), self.views)
        fit = ReconstructOptions(iterations=self.iterations, budget=_BUDGET)
        python = self.workers.python(console)
        with locked(self.out):
            tasks = []
            for number in range(self.first, self.first + self.scenes):
                work, out = self.out / "work" / f"{number:05d}", self.out / f"{number:05d}.npz"
                if not out.is_file():
                    scene = LightScene(draw_light_scene(self.seed, number, size), size, fit, self.mixtures)
                    tasks.append(Task(out.name, partial(make_light_examples, scene, work, out, python)))
            failures = self.workers.run(tasks, console) if tasks else []
            write_failures(self.out, failures, console)
        made = len(list(self.out.glob("*.npz")))
        console.say(f"{made} scenes with two examples each; {len(failures)} failed")
        console.result(self.out)
        return 1 if failures else 0


COMMAND = SynthLights
