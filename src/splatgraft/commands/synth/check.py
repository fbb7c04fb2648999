"""The command `synth check`: damaged or empty pictures of rendered pairs or benchmark scenes."""

from dataclasses import dataclass

from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.synthesis import benchmark
from splatgraft.workflow.rendered_data import check_pairs, write_failures


@dataclass(frozen=True)
class SynthCheck:
    """Look at every picture of a folder of pairs or of benchmark scenes, and say which are broken or empty."""

    out: Positional
    """What `synth pairs` or `synth benchmark` made."""

    def execute(self, console: Console) -> int:
        """Rewrite the manifest of pairs; 1 where something is faulty."""
        scenes = sorted(path.parent for path in self.out.glob("*/scene.json"))
        if not scenes:
            return check_pairs(self.out, [], console)
        faults = [wrong for wrong in map(benchmark.fault, scenes) if wrong]
        console.say(f"{len(scenes) - len(faults)} of {len(scenes)} scenes are sound")
        write_failures(self.out, faults, console)
        return 1 if faults else 0


COMMAND = SynthCheck
