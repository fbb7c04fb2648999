"""The command line: the table of commands, and the call of one of them with only its own imports."""

import importlib
import os
import sys
from collections.abc import Mapping, Sequence

_TABLE = (
    # command, module in splatgraft.commands, summary
    ("demo", "demo", "run a whole transfer on captures that come with the package"),
    ("try", "first_try", "run a whole transfer on two captures of your own, at draft quality"),
    ("check", "check", "look at photos before time is spent on them"),
    ("init", "init", "write a commented project.toml for two captures"),
    ("edit", "edit", "place the object and see the light, in the browser"),
    ("run", "run", "do what is stale in a project, resuming what was killed"),
    ("status", "status", "say what is done, what is stale and why"),
    ("scale", "scale", "say how large a capture is, by a known length or a marker"),
    ("capture", "steps.capture", "pose photos or a video, take over poses, or look at a scene from all around"),
    ("adopt", "steps.adopt", "take over a scene that was trained elsewhere"),
    ("reconstruct", "steps.reconstruct", "train a 3DGS scene on posed images"),
    ("segment", "steps.segment", "lift 2D masks to the Gaussians of the object"),
    ("compose", "steps.compose", "place the object in the target scene"),
    ("relight", "steps.relight", "give the object the light of its new place"),
    ("render", "steps.render", "render a scene or a composite from given cameras"),
    ("harmonize", "steps.harmonize", "make the light of each rendered view agree"),
    ("consolidate", "steps.consolidate", "fit the colours of the scene to the harmonised views"),
    ("evaluate", "steps.evaluate", "compare, picture and report"),
    ("export", "export", "write a scene or a result as a page, for another program, or as pictures"),
    ("evaluate benchmark", "evaluate_benchmark", "measure methods on scenes with a known truth"),
    ("evaluate paper", "evaluate_paper", "write the paper's tables from the authors' data set"),
    ("synth pairs", "synth.pairs", "render training pairs with Blender"),
    ("synth benchmark", "synth.benchmark", "render benchmark scenes with ground truth"),
    ("synth check", "synth.check", "find damaged or empty pictures among rendered pairs or scenes"),
    ("synth sheet", "synth.sheet", "one picture with all rendered scenes of a folder"),
    ("synth generated", "synth.generated", "make training pairs of pictures that FLUX paints"),
    ("synth orida", "synth.orida", "make training pairs of ORIDa's photographs"),
    ("synth spheres", "synth.spheres", "make training pairs of balls in a second each, to learn training"),
    ("synth lights", "synth.lights", "make examples for learning the light from captures"),
    ("synth pack", "synth.pack", "pack training pairs into tar files, also for object storage"),
    ("train flux", "train.flux", "train the paper's harmoniser on pairs"),
    ("train compact", "train.compact", "train the compact harmoniser on rendered pairs"),
    ("train light", "train.light", "train the correction of the estimated light"),
    ("train removal", "train.removal", "train the object removal on pairs"),
    ("train embed", "train.embed", "compute the empty prompt's embeddings once"),
    ("weights list", "weights.list", "say which networks there are, their licences, sizes, and what is fetched"),
    ("weights fetch", "weights.fetch", "fetch the weights of a network"),
    ("weights verify", "weights.verify", "compare fetched weights with their hashes"),
    ("doctor", "doctor", "say what is installed, what is missing and how to get it"),
)

COMMANDS = {command: summary for command, _, summary in _TABLE}
"""The summary of each command."""

GROUPS = {
    "synth": "synthetic training pairs and benchmark scenes",
    "weights": "weights of the networks of other people",
    "train": "training of the harmonisers and of the object removal",
}
"""First words that are no commands by themselves, with what their commands have in common."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns 0 on success, 2 where the user's data or arguments are at fault, 130 on Ctrl-C."""
    # torch and numba each have a pool of threads; one that spins while it waits takes the cores from the other
    # (measured on 2 busy cores: a reconstruction in 5 s instead of 80)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # FFmpeg inside OpenCV prints lines of its own about videos that our one line explains
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(_help(_HEAD, COMMANDS) + _TAIL)
        return 0
    if words[0] == "--version":
        from splatgraft import __version__

        print(__version__)
        return 0
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    try:
        return _dispatch(words)
    except KeyboardInterrupt:
        return _fail("interrupted; earlier results are complete, and the same command continues from here", 130)
    except ModuleNotFoundError as error:
        from splatgraft.runtime.optional_dependencies import extra_providing

        extra = extra_providing(error.name or "")
        if debug or extra is None:
            raise
        return _fail(f"{error.name}: expected an installed package, found none; pip install 'splatgraft[{extra}]'", 2)
    except (ValueError, OSError, MemoryError) as error:
        if debug:
            raise
        from splatgraft.runtime.help_link import help_link_of

        return _fail(" ".join(str(error).split()) or type(error).__name__, 2, help_link_of(error))


def _dispatch(words: list[str]) -> int:
    if words[:1] and words[0] in GROUPS and " ".join(words[:2]) not in COMMANDS:
        return _group(words[0], words[1:])
    if not words or words[0] not in {command.split()[0] for command in COMMANDS}:
        found = words[0] if words else "nothing"
        raise ValueError(f"splatgraft: expected a command among {', '.join(COMMANDS)}; found {found}")
    length = 2 if " ".join(words[:2]) in COMMANDS else 1
    command, rest = " ".join(words[:length]), words[length:]
    if ".steps." in module_of(command) and len(rest) == 1 and rest[0].endswith(".toml"):
        command, rest = "run", [rest[0], "--to", command]  # `reconstruct project.toml`: the project up to there
    import tyro

    from splatgraft.runtime.console import Console

    console, module = Console(), importlib.import_module(module_of(command))
    if hasattr(module, "current_arguments"):
        rest = module.current_arguments(rest, console.say)
    options = tyro.cli(
        module.COMMAND,
        prog=f"splatgraft {command}",
        args=rest,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff, tyro.conf.CascadeSubcommandArgs),
    )
    if hasattr(options, "execute"):
        return options.execute(console)
    # steps load torch, which takes seconds
    from splatgraft.project.step import perform

    console.result(perform(options, console))
    return 0


def module_of(command: str) -> str:
    """The module that defines `COMMAND` for a command, e.g. "evaluate benchmark"."""
    return "splatgraft.commands." + {name: module for name, module, _ in _TABLE}[command]


def _group(group: str, rest: list[str]) -> int:
    inner = {name: summary for name, summary in COMMANDS.items() if name.split()[0] == group}
    if rest[:1] in (["-h"], ["--help"]):
        usage = f"usage: splatgraft {group} COMMAND [OPTIONS]; `splatgraft {group} COMMAND --help` says more"
        print(_help(f"{usage}\n\n{GROUPS[group]}", inner))
        return 0
    found = f"{group} {rest[0]}" if rest else group
    raise ValueError(f"splatgraft: expected a command among {', '.join(inner)}; found {found}")


_HEAD = "usage: splatgraft COMMAND [OPTIONS]; `splatgraft COMMAND --help` says more"
_TAIL = """

`splatgraft reconstruct project.toml` does that project up to there.
--debug, with any command: show the traceback of an error. --version: print the version."""


def _help(head: str, commands: Mapping[str, str]) -> str:
    lines = [f"  {name:<18} {summary}" for name, summary in commands.items()]
    return "\n".join([f"{head}\n\ncommands:", *lines])


def _fail(sentence: str, code: int, link: str = "") -> int:
    more = f" (see {link})" if link else ""
    print(f"splatgraft: {sentence}{more}", file=sys.stderr)
    return code
