"""The command `synth check`: damaged or empty pictures of rendered pairs or benchmark scenes."""

from dataclasses import dataclass

from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft_paper.synthesis import benchmark
from splatgraft_paper.synthesis.rendered_data import check_pairs, write_failures


@dataclass(frozen=True)
class SynthCheck:
    """Check every picture of a folder of pairs or benchmark scenes, and list the damaged and empty ones."""

    out: Positional
    """The folder that `synth pairs` or `synth benchmark` wrote."""

    def execute(self, console: Console) -> int:
        """Rewrite the manifest of pairs; 1 where something is faulty."""
        scenes = sorted(path.parent for path in self.out.glob("*/scene.json"))
        if not scenes:
            return check_pairs(self.out, [], console)
        faults = [wrong for wrong in map(benchmark.find_defect, scenes) if wrong]
        console.say(f"{len(scenes) - len(faults)} of {len(scenes)} scenes are sound")
        write_failures(self.out, faults, console)
        return 1 if faults else 0


COMMAND = SynthCheck
