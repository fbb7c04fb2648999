"""The command `synth lights`: examples for learning the light at a place from what captures show of it."""

from dataclasses import dataclass, field
from functools import partial

from splatgraft.project.folder_lock import locked
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.runtime.workers import Task
from splatgraft.workflow.light_examples import draw_light_scene, make_light_examples
from splatgraft.workflow.rendered_data import RenderWorkers, write_failures


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
    workers: RenderWorkers = field(default_factory=RenderWorkers)

    def execute(self, console: Console) -> int:
        """Make what is missing; 1 where a scene failed."""
        python = self.workers.python(console)
        with locked(self.out):
            tasks = []
            for number in range(self.first, self.first + self.scenes):
                work, out = self.out / "work" / f"{number:05d}", self.out / f"{number:05d}.npz"
                if not out.is_file():
                    make = partial(make_light_examples, draw_light_scene(self.seed, number), work, out, python)
                    tasks.append(Task(out.name, make))
            failures = self.workers.run(tasks, console) if tasks else []
            write_failures(self.out, failures, console)
        made = len(list(self.out.glob("*.npz")))
        console.say(f"{made} scenes with two examples each; {len(failures)} failed")
        console.result(self.out)
        return 1 if failures else 0


COMMAND = SynthLights
