"""Fails the build where the code has an error message that troubleshooting.md does not explain.

A message is the text given to ValueError, OSError, RuntimeError or `cli._fail` in src, or any text in the house's form
"FILE: expected X, found Y"; its replaced parts become "…".
Inline code in the first column of the page's tables is a pattern, in which "…" stands for a replaced part, at the
end for any text.
"""

import ast
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/troubleshooting.md"
_MAKERS = ("ValueError", "OSError", "RuntimeError", "_fail")
_IS_MESSAGE = re.compile(r": expected .*found", re.DOTALL)
"""Text that some other function turns into an error."""
_WORDLESS = re.compile(r"[^\w]|expected|found|…|x")
"""What is left of a message without these are the words that tell it from others."""


def on_pre_build(config: MkDocsConfig) -> None:
    """Compare the page with the code."""
    messages, patterns = dict(raised_messages()), page_patterns()
    matchers = {pattern: _matcher(pattern) for pattern in patterns}
    missing = [f"{where}: {text}" for text, where in messages.items() if not _matched(text, matchers.values())]
    unused = [pattern for pattern, matcher in matchers.items() if not any(map(matcher.fullmatch, messages))]
    if missing or unused:
        lines = ["troubleshooting.md: expected a pattern for each message in src, found none for:", *missing]
        lines += ["patterns that match no message in src:", *unused] if unused else []
        raise PluginError("\n".join(lines))


def raised_messages() -> Iterator[tuple[str, str]]:
    """Every message with words of its own, and the file that has it."""
    for path in sorted((ROOT / "src").rglob("*.py")):
        for scope in ast.walk(ast.parse(path.read_text())):
            if isinstance(scope, ast.FunctionDef | ast.AsyncFunctionDef):
                for text in _messages(scope):
                    yield text, path.relative_to(ROOT / "src/splatgraft").as_posix()


def _messages(function: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[str]:
    nodes = list(ast.walk(function))
    texts = {
        target.id: node.value
        for node in nodes
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.JoinedStr)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    given = [n.args[0] for n in nodes if isinstance(n, ast.Call) and getattr(n.func, "id", "") in _MAKERS and n.args]
    built = (_template(node, texts) for node in nodes if isinstance(node, ast.JoinedStr))
    for text in (*(_template(node, texts) for node in given), *(text for text in built if _IS_MESSAGE.search(text))):
        if _WORDLESS.sub("", text):
            yield text


def page_patterns() -> list[str]:
    """The patterns of the page."""
    first_cells = re.findall(r"^\| (`.*?`) \|", PAGE.read_text(), re.MULTILINE)
    return [pattern for cell in first_cells for pattern in re.findall(r"`([^`]+)`", cell)]


def _template(node: ast.AST, texts: Mapping[str, ast.expr]) -> str:
    """The text of a string expression, with "…" for what is known only when it runs; `texts` are local variables."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value.replace("`", "'")
    if isinstance(node, ast.JoinedStr):
        return "".join(_template(part, texts) for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _template(node.left, texts) + _template(node.right, texts)
    if isinstance(node, ast.FormattedValue) and isinstance(node.value, ast.Name) and node.value.id in texts:
        return _template(texts[node.value.id], {})
    return "…"


def _matcher(pattern: str) -> re.Pattern[str]:
    """A "…" at the end stands for any text, others for what is replaced in the code."""
    *parts, last = map(re.escape, pattern.split("…"))
    return re.compile("".join(f"{part}[^A-Za-z]*" for part in parts) + (last or ".*"), re.DOTALL)


def _matched(text: str, matchers: Iterable[re.Pattern[str]]) -> bool:
    return any(matcher.fullmatch(text) for matcher in matchers)
