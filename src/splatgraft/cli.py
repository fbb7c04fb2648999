"""The command line: finds a command, imports only its module, and prints errors in one line."""

import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from io import TextIOWrapper
from typing import Any

from splatgraft.project.step_table import STEPS

ENTRY_POINTS = "splatgraft.commands"
"""Group of entry points by which other packages add commands."""

_TABLE = (
    # command, module in splatgraft, summary
    ("demo", "commands.demo", "run a whole transfer on captures that come with the package"),
    ("try", "commands.first_try", "run a whole transfer on two captures of your own, at draft quality"),
    ("check", "commands.check", "look at photos before time is spent on them"),
    ("init", "commands.init", "write a commented project.toml for two captures"),
    ("edit", "commands.edit", "place the object and see the light, in the browser"),
    ("run", "commands.run", "do what is stale in a project, resuming what was killed"),
    ("status", "commands.status", "say what is done, what is stale and why"),
    ("scale", "commands.scale", "say how large a capture is, by a known length or a marker"),
    *((row.command, f"steps.{row.command}", row.summary) for row in STEPS),
    ("harmonize photo", "commands.harmonize_photo", "make the light of one picture agree, without a scene"),
    ("light", "commands.light", "write the light at a place as an environment map and lamps, for other programs"),
    ("export", "commands.export", "write a scene or a result as a page, for another program, or as pictures"),
    ("doctor", "commands.doctor", "say what is installed, what is missing and how to get it"),
)


@dataclass(frozen=True)
class Command:
    """One command of the command line."""

    place: str
    """MODULE or MODULE:CLASS of the dataclass of its arguments; without a class it is `COMMAND`."""
    summary: str
    """Summary in the list of commands."""

    def load(self) -> Any:
        """Import the command's module and return the dataclass of its arguments."""
        module, _, name = self.place.partition(":")
        return getattr(importlib.import_module(module), name or "COMMAND")


@cache
def commands() -> Mapping[str, Command]:
    """Return all commands by name: those of this package and those of installed packages (entry point `ENTRY_POINTS`).

    An entry point names rows (name, MODULE:CLASS, summary); each name begins with the name of the entry point.
    """
    found = {name: Command(f"splatgraft.{module}", summary) for name, module, summary in _TABLE}
    for entry in entry_points(group=ENTRY_POINTS):
        found |= {name: Command(place, summary) for name, place, summary in entry.load()}
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0 for success, 2 for bad data or arguments, 130 after Ctrl-C."""
    # torch and numba each have a pool of threads; idle threads that spin take the cores from the other pool
    # (measured on 2 busy cores: a reconstruction in 5 s instead of 80)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # FFmpeg inside OpenCV prints lines of its own about videos that our one line explains
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    if isinstance(sys.stdout, TextIOWrapper):  # not every encoding of Windows has all letters of a file name
        sys.stdout.reconfigure(errors="backslashreplace")
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(_help(_HEAD, _first_words()) + _TAIL)
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
        return _fail(_in_one_line(error), 2)


def _dispatch(words: list[str]) -> int:
    table = commands()
    lengths = (length for length in range(min(3, len(words)), 0, -1) if " ".join(words[:length]) in table)
    length = next(lengths, 0)
    if not length:
        return _group(words)
    command, rest = " ".join(words[:length]), words[length:]
    if ".steps." in table[command].place and len(rest) == 1 and rest[0].endswith(".toml"):
        command, rest = "run", [rest[0], "--to", command]  # `reconstruct project.toml`: the project up to there
    import tyro

    from splatgraft.runtime.console import Console

    console, kind = Console(), table[command].load()
    if hasattr(kind, "current_arguments"):
        rest = kind.current_arguments(rest, console.say)
    options = tyro.cli(
        kind,
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


def _group(words: list[str]) -> int:
    """Print help on the commands that begin with these words, or raise a ValueError that lists them."""
    wants_help = bool(words) and words[-1] in ("-h", "--help")
    first = words[:-1] if wants_help else words
    while first and not _below(first):
        first = first[:-1]
    inner = _below(first) if first else _first_words()
    if wants_help and first == words[:-1]:
        group = " ".join(first)
        usage = f"usage: splatgraft {group} COMMAND [OPTIONS]; `splatgraft {group} COMMAND --help` says more"
        print(_help(usage, inner))
        return 0
    found = " ".join(words[: len(first) + 1]) or "nothing"
    raise ValueError(f"splatgraft: expected a command among {', '.join(inner)}; found {found}")


def _below(first: Sequence[str]) -> dict[str, str]:
    start = " ".join([*first, ""])
    return {name: one.summary for name, one in commands().items() if name.startswith(start)}


def _first_words() -> dict[str, str]:
    """Return the summaries of commands of one word with their sub-commands, and one line for each other group."""
    table = commands()
    alone = {name for name in table if " " not in name}
    groups = {name.split()[0] for name in table} - alone
    lines = {f"{first} ...": f"the commands that `splatgraft {first} --help` lists" for first in sorted(groups)}
    return {name: one.summary for name, one in table.items() if name.split()[0] in alone} | lines


_HEAD = "usage: splatgraft COMMAND [OPTIONS]; `splatgraft COMMAND --help` says more"
_TAIL = """

`splatgraft reconstruct project.toml` does that project up to there.
--debug, with any command: show the traceback of an error. --version: print the version."""


def _help(head: str, commands: Mapping[str, str]) -> str:
    lines = [f"  {name:<22} {summary}" for name, summary in commands.items()]
    return "\n".join([f"{head}\n\ncommands:", *lines])


def _in_one_line(error: Exception) -> str:
    if isinstance(error, OSError):
        from splatgraft.runtime.files import os_error_line

        return os_error_line(error)
    return " ".join(str(error).split()) or type(error).__name__


def _fail(sentence: str, code: int) -> int:
    print(f"splatgraft: {sentence}", file=sys.stderr)
    return code
