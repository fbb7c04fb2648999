"""Pages of the site that are made from the code: commands, keys of project.toml, the Python API; and the root's pages.

mkdocs calls `on_files` once per build.
"""

import argparse
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import tyro
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import splatgraft
from splatgraft.cli import commands

ROOT = Path(__file__).resolve().parents[2]
ROOT_PAGES = {f"{name.lower()}.md": f"{name}.md" for name in ("CHANGELOG", "ARCHITECTURE", "CONTRIBUTING")}
_STACKED = '<div class="stacked" markdown>\n'
_END_OF_HELP = re.compile(r"\s*\((required|default: (?P<default>.*)|optional|repeatable)\)\s*$", re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    pages = {name: _root_page(ROOT / path) for name, path in ROOT_PAGES.items()}
    pages["reference/commands.md"] = "\n".join(_commands_page())
    pages["reference/project.md"] = "\n".join(_project_page())
    pages["reference/api.md"] = "\n".join(_api_page())
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def _root_page(path: Path) -> str:
    text = path.read_text(encoding="utf-8").replace("](docs/", "](")
    for name, target in ROOT_PAGES.items():
        text = text.replace(f"]({target})", f"]({name})")
    return text


def _commands_page() -> Iterator[str]:
    yield "# Commands\n"
    yield "Made from the code of each command; `splatgraft COMMAND --help` prints the same.\n"
    yield "| command | purpose |\n| --- | --- |"
    for name, purpose in ((name, one.summary) for name, one in commands().items()):
        yield f"| [`{name}`](#{_anchor(name)}) | {purpose} |"
    yield (
        "\n`splatgraft COMMAND project.toml` runs the project up to that step. `--debug`, with any command, shows the"
        " traceback of an error. The exit code is 0 after success, 2 after an error in the input, 130 after Ctrl-C."
    )
    for name, purpose in ((name, one.summary) for name, one in commands().items()):
        yield f"\n## splatgraft {name} {{#{_anchor(name)}}}\n"
        yield from _parser_section(_parser(name), purpose)


def _parser(name: str) -> Any:
    with warnings.catch_warnings():
        # tyro has no other public way to its options; constraints.txt pins its version
        warnings.simplefilter("ignore", DeprecationWarning)
        return tyro.extras.get_parser(
            commands()[name].load(),
            prog=f"splatgraft {name}",
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff, tyro.conf.CascadeSubcommandArgs),
        )


def _anchor(name: str) -> str:
    return "command-" + name.replace(" ", "-")


def _parser_section(parser: argparse.ArgumentParser, purpose: str) -> Iterator[str]:
    """Description and options of a command, then of its sub-commands; options that all of them take come first."""
    yield (parser.description or purpose[:1].upper() + purpose[1:] + ".").strip() + "\n"
    actions = [action for action in parser._actions if action.dest != "help"]
    inner = {
        name: sub for action in actions if isinstance(action.choices, dict) for name, sub in action.choices.items()
    }
    shared = set.intersection(*({action.dest for action in sub._actions} for sub in inner.values())) if inner else set()
    first = next(iter(inner.values()))._actions if inner else []
    plain = [action for action in actions if not isinstance(action.choices, dict)]
    yield from _option_table([*plain, *(action for action in first if action.dest in shared - {"help"})])
    for name, sub in inner.items():
        yield f"\n### {sub.prog.strip() or name}\n\n{(sub.description or '').strip()}\n"
        yield from _option_table([action for action in sub._actions if action.dest not in shared])


def _option_table(actions: Sequence[argparse.Action]) -> Iterator[str]:
    if actions:
        yield _STACKED
        yield "| option | value | default | meaning |\n| --- | --- | --- | --- |"
        yield from map(_option_row, actions)
        yield "\n</div>\n"


def _option_row(action: argparse.Action) -> str:
    text = " ".join(str(action.help or "").split())
    default = "required" if action.required else ""
    if found := _END_OF_HELP.search(text):
        text = text[: found.start()]
        default = f"`{found['default']}`" if found["default"] else default
    name = f"`{action.option_strings[-1]}`" if action.option_strings else f"`{action.metavar}` (position)"
    value = "flag" if action.nargs == 0 else f"`{action.metavar}`"
    return "| " + " | ".join(_cell(part) for part in (name, value, default, text)) + " |"


def _cell(text: str) -> str:
    return text.replace("{None}|", "").replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[")


def _project_page() -> Iterator[str]:
    yield "# project.toml\n"
    yield (
        "Made from the code. A project file has the tables `[source]` and `[target]`, and one optional table per step."
        " Paths are relative to the file. The keys of a step are the options of its command, with `_` for `-`;"
        " `[source.reconstruct]` and `[target.reconstruct]` apply to one capture alone. `splatgraft init --full` writes"
        " a commented file with all of them.\n"
    )
    for table in _tables():
        yield f"\n## [{table.name}] {{#{table.name}}}\n\n{table.meaning}\n"
        yield from _key_table(table.keys)
        for variant in table.variants:
            yield f"\n### {variant.name} {{#{table.name}-{variant.name}}}\n\n{variant.meaning}\n"
            yield from _key_table(variant.keys)


def _tables() -> Sequence[Any]:
    from splatgraft.workflow.project_reference import project_keys

    return project_keys()


def _key_table(keys: Sequence[Any]) -> Iterator[str]:
    if not keys:
        return
    yield _STACKED
    yield "| key | type | default | meaning |\n| --- | --- | --- | --- |"
    for key in keys:
        cells = (f"`{key.name}`", key.type, f"`{key.default}`" if key.default != "none" else "", key.meaning)
        yield "| " + " | ".join(_cell(" ".join(str(cell).split())) for cell in cells) + " |"
    yield "\n</div>\n"


def _api_page() -> Iterator[str]:
    yield "# Python API\n"
    yield (
        "`import splatgraft as sg` gives the names below; each is loaded when it is first used. Values are frozen"
        " dataclasses of tensors, functions return new ones. Quantities are in radians, world units, sRGB in [0, 1],"
        " OpenCV camera axes and wxyz quaternions unless a name says otherwise. The scripts in `examples/` use the API"
        " from capture to result.\n"
    )
    names = sorted(splatgraft.__all__, key=str.lower)
    classes = [name for name in names if isinstance(getattr(splatgraft, name), type)]
    for title, group in (("Functions", [name for name in names if name not in classes]), ("Values", classes)):
        yield f"\n## {title}\n"
        for name in group:
            value = getattr(splatgraft, name)
            # mkdocstrings reads the source, where only the place of a definition has it
            yield f"\n::: {value.__module__}.{value.__qualname__}"
            yield f"    options:\n      heading: {name}\n      toc_label: {name}\n"
