"""The commands `splatgraft paper ...`, which the command line finds by the entry point in pyproject.toml."""

_TABLE = (
    # command, module in splatgraft_paper.commands, summary
    ("benchmark", "benchmark", "measure methods on scenes with a known truth"),
    ("tables", "tables", "write the paper's tables from the authors' data set"),
    ("synth pairs", "synth.pairs", "render training pairs with Blender"),
    ("synth benchmark", "synth.benchmark", "render benchmark scenes with ground truth"),
    ("synth check", "synth.check", "find damaged or empty pictures among rendered pairs or scenes"),
    ("synth sheet", "synth.sheet", "one picture with all rendered scenes of a folder"),
    ("synth generated", "synth.generated", "make training pairs of pictures that FLUX paints"),
    ("synth orida", "synth.orida", "make training pairs of ORIDa's photographs"),
    ("synth spheres", "synth.spheres", "make training pairs of balls in a second each, to learn training"),
    ("synth pack", "synth.pack", "pack training pairs into tar files, also for object storage"),
    ("train flux", "train.flux", "train the paper's harmoniser on pairs"),
    ("train compact", "train.compact", "train the compact harmoniser on rendered pairs"),
    ("train removal", "train.removal", "train the object removal on pairs"),
    ("train embed", "train.embed", "compute the empty prompt's embeddings once"),
)

COMMANDS = tuple((f"paper {name}", f"splatgraft_paper.commands.{module}", summary) for name, module, summary in _TABLE)
"""Name, module and summary of each command."""
