"""The command line: finds the command in `commands/`, and imports only what that command needs."""

import importlib
import os
import sys
from collections.abc import Sequence

COMMANDS = {
    "init": "write a commented project.toml for two captures",
    "edit": "place the object and see the light, in the browser",
    "run": "do what is stale in a project, resuming what was killed",
    "status": "say what is done, what is stale and why",
    "capture": "pose photos or a video, take over poses, or look at a scene from all around",
    "adopt": "take over a scene that was trained elsewhere",
    "reconstruct": "train a 3DGS scene on posed images",
    "segment": "lift 2D masks to the Gaussians of the object",
    "compose": "place the object in the target scene",
    "relight": "give the object the light of its new place",
    "render": "render a scene or a composite from given cameras",
    "harmonize": "make the light of each rendered view agree",
    "consolidate": "fit the colours of the scene to the harmonised views",
    "evaluate": "compare, picture and report",
    "evaluate benchmark": "measure methods on scenes with a known truth",
    "synth": "render training pairs and benchmark scenes with Blender",
    "synth generated": "make training pairs of pictures that FLUX paints",
    "synth orida": "make training pairs of ORIDa's photographs",
    "train": "train harmonisers and the object removal on pairs",
    "doctor": "say what is installed, what is missing and how to get it",
}


_MODULES = {
    **{name: f"steps.{name}" for name in ("capture", "adopt", "reconstruct", "segment", "compose", "relight")},
    **{name: f"steps.{name}" for name in ("render", "harmonize", "consolidate", "evaluate")},
    "synth": "synth.synth",
    "synth_generated": "synth.generated",
    "synth_orida": "synth.orida",
    "train": "train.train",
}
"""Modules in splatgraft.commands of the commands that are in one of its sub-folders."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Do one command; 0 where all went well, 2 where the user's data or arguments are at fault, 130 on Ctrl-C."""
    # torch and numba each have a pool of threads; one that spins while it waits takes the cores from the other
    # (measured on 2 busy cores: a reconstruction in 5 s instead of 80)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(_help())
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
        return _fail("interrupted; earlier results are whole, and the same command goes on from here", 130)
    except ModuleNotFoundError as error:
        from splatgraft.runtime.optional_dependencies import extra_providing

        extra = extra_providing(error.name or "")
        if debug or extra is None:
            raise
        return _fail(f"{error.name}: expected an installed package, found none; pip install 'splatgraft[{extra}]'", 2)
    except (ValueError, OSError, MemoryError) as error:
        if debug:
            raise
        return _fail(" ".join(str(error).split()) or type(error).__name__, 2)


def _dispatch(words: list[str]) -> int:
    if not words or words[0] not in COMMANDS:
        found = words[0] if words else "nothing"
        raise ValueError(f"splatgraft: expected a command among {', '.join(COMMANDS)}; found {found}")
    length = 2 if " ".join(words[:2]) in COMMANDS else 1
    command, rest = "_".join(words[:length]), words[length:]
    if command not in ("init", "edit", "run", "status", "doctor") and len(rest) == 1 and rest[0].endswith(".toml"):
        command, rest = "run", [rest[0], "--to", command]  # `reconstruct project.toml`: the project up to there

    import tyro

    from splatgraft.project.step import perform
    from splatgraft.runtime.console import Console

    console, module = Console(), importlib.import_module(module_of(command))
    if hasattr(module, "current_arguments"):
        rest = module.current_arguments(rest, console.say)
    options = tyro.cli(
        module.COMMAND,
        prog=f"splatgraft {' '.join(words[:length])}",
        args=rest,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff, tyro.conf.CascadeSubcommandArgs),
    )
    if hasattr(options, "execute"):
        return options.execute(console)
    console.result(perform(options, console))
    return 0


def module_of(command: str) -> str:
    """The module that has `COMMAND` for the command of that name, e.g. "evaluate benchmark"."""
    name = command.replace(" ", "_")
    return f"splatgraft.commands.{_MODULES.get(name, name)}"


def _help() -> str:
    lines = [f"  {name:<18} {sentence}" for name, sentence in COMMANDS.items()]
    head = "usage: splatgraft COMMAND [OPTIONS]; `splatgraft COMMAND --help` says more\n\ncommands:"
    tail = (
        "\n`splatgraft reconstruct project.toml` does that project up to there."
        "\n--debug, with any command: show the traceback of an error. --version: print the version."
    )
    return "\n".join([head, *lines, tail])


def _fail(sentence: str, code: int) -> int:
    print(f"splatgraft: {sentence}", file=sys.stderr)
    return code
