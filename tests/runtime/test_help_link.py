"""Links of errors and warnings lead to a section of the page that exists and that lists the messages of the module."""

import importlib.util
import re
from collections import defaultdict
from pathlib import Path
from types import ModuleType

import pytest

from splatgraft.cli import commands, main
from splatgraft.runtime import help_link as links

ROOT = Path(__file__).parents[2]


def slug(title: str) -> str:
    """The anchor of a heading, by the rule of Python-Markdown and of code hosts."""
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower())


def sections() -> dict[str, str]:
    """The text of each section of the page, by anchor."""
    parts = re.split(r"^#{2,3} (.*)$", (ROOT / links.PAGE).read_text(), flags=re.MULTILINE)
    return {slug(title): text for title, text in zip(parts[1::2], parts[2::2], strict=True)}


@pytest.fixture(scope="module")
def coverage() -> ModuleType:
    """The hook of the site's build that finds all messages of the code."""
    pytest.importorskip("mkdocs")
    spec = importlib.util.spec_from_file_location("coverage", ROOT / "docs/hooks/message_coverage.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_anchor_is_a_section_of_the_page() -> None:
    assert set(links._SECTIONS.values()) | {links._DEFAULT} <= set(sections())


def test_every_name_of_the_table_is_a_module() -> None:
    names = [f"splatgraft.{name}" for name in links._SECTIONS]
    assert not [name for name in names if importlib.util.find_spec(name) is None]


def test_every_command_has_a_section() -> None:
    unexplained = ("run", "status", "doctor")
    modules = [one.place.partition(":")[0] for name, one in commands().items() if name not in unexplained]
    assert all(links._section(module) for module in modules if module.startswith("splatgraft."))


def test_the_section_lists_the_messages_of_the_module(coverage: ModuleType) -> None:
    texts = defaultdict(set)
    for text, file in coverage.raised_messages():
        texts["splatgraft." + file.removesuffix(".py").replace("/", ".").removesuffix(".__init__")].add(text)
    by_anchor = {
        anchor: [
            coverage._matcher(pattern)
            for cell in re.findall(r"^\| (`.*?`) \|", text, re.MULTILINE)
            for pattern in re.findall(r"`([^`]+)`", cell)
        ]
        for anchor, text in sections().items()
    }
    for module, messages in texts.items():
        matchers = by_anchor[links.help_link(module).split("#")[1]]
        listed = [text for text in messages if coverage._matched(text, matchers)]
        # a few modules have messages of two sections
        assert 2 * len(listed) >= len(messages), (module, links.help_link(module))


def test_an_error_has_the_link_of_where_it_was_raised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, anchor in (
        (["run", str(tmp_path)], "projecttoml"),
        (["reconstruct", str(tmp_path)], "capture-photos-and-videos"),
        (["nonsense"], "start-and-options"),
    ):
        assert main(words) == 2
        line = capsys.readouterr().err
        assert line.endswith(f"(see docs/troubleshooting.md#{anchor})\n"), line
