"""Fails the build where a page names a file or a function of the code that does not exist.

Checked is inline code such as `relighting/transfer.py` (below src/splatgraft or the repository) and
`relighting/transfer.py: relight`, whose names must be defined at the file's top level or in one of its classes.
"""

import ast
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError

ROOT = Path(__file__).resolve().parents[2]
_REFERENCE = re.compile(r"`((?:[\w.-]+/)+[\w-]+\.(?:py)|(?:[\w-]+/)+)(?:: ([\w., ]+))?`")
_ROOTS = (ROOT / "src/splatgraft", ROOT)
_OWN = ("src", "benchmarks", "examples", "data", "docs", "tests", ".github", ".ci")


def on_pre_build(config: MkDocsConfig) -> None:
    """Look for every reference."""
    pages = [*(ROOT / "docs").rglob("*.md"), *(ROOT / name for name in ("README.md", "ARCHITECTURE.md"))]
    missing = [f"{page.relative_to(ROOT)}: {problem}" for page in pages for problem in _problems(page)]
    if missing:
        raise PluginError("\n".join(["expected files and names that exist in the code, found:", *missing]))


def _problems(page: Path) -> list[str]:
    problems = []
    for path, names in _REFERENCE.findall(page.read_text(encoding="utf-8")):
        first = path.split("/")[0]
        if first not in _OWN and not (_ROOTS[0] / first).is_dir():
            continue  # a folder of the user
        found = next((root / path for root in _ROOTS if (root / path).exists()), None)
        if found is None:
            problems.append(f"no {path}")
        elif names:
            defined = _names(ast.parse(found.read_text(encoding="utf-8")).body)
            problems += [f"no {name} in {path}" for name in names.split(", ") if name not in defined]
    return problems


def _names(body: list[ast.stmt], prefix: str = "") -> set[str]:
    names: set[str] = set()
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(prefix + node.name)
        if isinstance(node, ast.ClassDef):
            names |= _names(node.body, f"{node.name}.")
        if isinstance(node, ast.Assign):
            names |= {prefix + target.id for target in node.targets if isinstance(target, ast.Name)}
    return names
