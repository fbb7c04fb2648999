"""The commands `splatgraft paper ...`, which the command line finds by the entry point in pyproject.toml."""

_TABLE = (
    # command, module:class in splatgraft_paper.commands, summary
    ("benchmark", "benchmark:EvaluateBenchmark", "measure methods on scenes with a known truth"),
    ("exam", "exam:Exam", "measure the light transfer on new scenes drawn from a number (held-out benchmark)"),
    ("consolidate", "consolidate:Consolidate", "the paper's consolidation: Adam on LPIPS, and iterative updates"),
    ("reproduce", "reproduce:Reproduce", "make the data, the models and the tables of the paper, in stages"),
    ("check-release", "check_release:CheckRelease", "compare the released weights with the authors' pictures, in 2D"),
    ("compare", "compare:Compare", "compare image models on one view of each scene, as a sheet"),
    ("tables", "tables:EvaluatePaper", "write the paper's tables from the authors' data set"),
    ("synth pairs", "synth:SynthPairs", "render training pairs with Blender"),
    ("synth benchmark", "synth:SynthBenchmark", "render benchmark scenes with ground truth"),
    ("synth spheres", "synth:SynthSpheres", "make training pairs of balls in a second each, to learn training"),
    ("synth generated", "generated:GeneratedPairs", "make training pairs of pictures that FLUX paints"),
    ("synth orida", "generated:OridaPairs", "make training pairs of ORIDa's photographs"),
    ("train flux", "train:TrainFlux", "train the paper's harmoniser on pairs"),
    ("train removal", "train:TrainRemoval", "train the object removal on pairs"),
    ("train embed", "train:TrainEmbed", "compute the empty prompt's embeddings once"),
)

COMMANDS = tuple((f"paper {name}", f"splatgraft_paper.commands.{place}", summary) for name, place, summary in _TABLE)
"""Name, module:class and summary of each command."""
