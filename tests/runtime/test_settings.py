"""TOML tables become typed settings, or one line that names the error and its place."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

import pytest

from splatgraft.runtime.settings import Table, from_table, read_toml


@dataclass(frozen=True)
class Inner:
    steps: int = 3
    place: tuple[float, float, float] | None = None
    device: str = "cpu"


@dataclass(frozen=True)
class Outer:
    capture: Path
    out: Path
    method: Literal["fast", "adam"] = "fast"
    rate: float = 0.5
    eval: bool = False
    names: tuple[str, ...] = ()
    options: Inner = field(default_factory=lambda: Inner(device="auto"))


@dataclass(frozen=True)
class Plain:
    name: ClassVar[str] = "plain"


@dataclass(frozen=True)
class Fancy:
    name: ClassVar[str] = "fancy"
    shine: float = 1.0


@dataclass(frozen=True)
class Choosing:
    kind: Plain | Fancy = field(default_factory=Plain)
    count: int = 1


def table(**values: object) -> Table:
    return Table(values, "project.toml [outer]", Path("folder"))


def test_keys_of_nested_options_share_the_table_and_paths_are_relative_to_the_file() -> None:
    built = from_table(
        Outer, table(capture="c", rate=2, steps=9, place=[1, 2.5, 3], names=["a", "b"]), {"out": Path("x")}
    )
    options = Inner(steps=9, place=(1.0, 2.5, 3.0), device="auto")
    assert built == Outer(capture=Path("folder/c"), out=Path("x"), rate=2.0, names=("a", "b"), options=options)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"stepz": 3}, "expected keys among capture, device, eval, method, names, place, rate, steps; found stepz"),
        ({"out": "x"}, "found out"),
        ({"steps": 2.5}, "steps: expected int, found 2.5"),
        ({"steps": True}, "steps: expected int, found True"),
        ({"rate": "fast"}, "rate: expected float, found 'fast'"),
        ({"eval": 1}, "eval: expected bool, found 1"),
        ({"method": "slow"}, "method: expected 'fast' or 'adam', found 'slow'"),
        ({"place": [1, 2]}, r"place: expected tuple\[float, float, float\], found \[1, 2\]"),
        ({"names": ["a", 1]}, "names: expected str, found 1"),
        ({"capture": 7}, "capture: expected Path, found 7"),
    ],
)
def test_what_does_not_fit_is_told_by_file_and_key(values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=rf"^project.toml \[outer\].*{message}"):
        from_table(Outer, table(**{"capture": "c", **values}), {"out": Path("x")})


def test_a_choice_is_a_key_and_the_keys_of_the_chosen_share_the_table() -> None:
    assert from_table(Choosing, table(), {}) == Choosing()
    assert from_table(Choosing, table(kind="fancy", shine=2, count=3), {}) == Choosing(Fancy(2.0), 3)
    with pytest.raises(ValueError, match='expected keys among count, kind with kind = "plain"; found shine'):
        from_table(Choosing, table(shine=2.0), {})
    with pytest.raises(ValueError, match="kind: expected one of fancy, plain; found 'dull'"):
        from_table(Choosing, table(kind="dull"), {})


def test_a_missing_key_is_told() -> None:
    with pytest.raises(ValueError, match="expected the key capture, found none"):
        from_table(Outer, table(), {"out": Path("x")})


def test_no_file_or_no_toml_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected a TOML file, found none"):
        read_toml(tmp_path / "project.toml")
    for content in (b"[a", b"\xff\xfe", b"a = 1\na = 2"):
        (tmp_path / "project.toml").write_bytes(content)
        with pytest.raises(ValueError, match=r"project.toml: expected TOML, found"):
            read_toml(tmp_path / "project.toml")
