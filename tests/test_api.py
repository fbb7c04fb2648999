"""`import splatgraft as sg`: its names are those recorded in api.txt, and no sub-package hides one.

After a change of the API that is wanted, `python tests/test_api.py` records it anew.
"""

import importlib
import inspect
import pkgutil
from dataclasses import fields, is_dataclass
from pathlib import Path

import splatgraft as sg

RECORDED = Path(__file__).with_name("api.txt")


def signature(function: object) -> str:
    """Return the parameters in order, keyword-only ones after `*`, with `=` if there is a default."""
    words: list[str] = []
    for parameter in inspect.signature(function).parameters.values():  # pyright: ignore[reportArgumentType]
        if parameter.kind is parameter.KEYWORD_ONLY and "*" not in words:
            words.append("*")
        words.append(parameter.name + ("" if parameter.default is parameter.empty else "="))
    return f"({', '.join(words)})"


def described(name: str) -> list[str]:
    """Return the signature of a function or a class, and the public methods and properties of the class below it."""
    found = getattr(sg, name)
    if not inspect.isclass(found):
        return [name + signature(found)]
    taken = {field.name for field in fields(found)} if is_dataclass(found) else set()
    lines = [name + (signature(found) if is_dataclass(found) else "")]
    for key, value in sorted(vars(found).items()):
        method = value.__func__ if isinstance(value, staticmethod) else value
        if not key.startswith("_") and key not in taken:
            lines.append(f"    {key}{signature(method) if inspect.isfunction(method) else ''}")
    return lines


def api() -> str:
    return "\n".join(line for name in sorted(sg.__all__) for line in described(name)) + "\n"


def test_the_api_is_the_recorded_one() -> None:
    assert api() == RECORDED.read_text()


def test_every_public_name_is_documented() -> None:
    assert not [name for name in sg.__all__ if not (getattr(sg, name).__doc__ or "").strip()]


def test_type_checkers_see_the_names_that_are_loaded() -> None:
    assert sorted(sg._sources()) == sorted(sg.__all__)


def test_all_holds_nothing_private_and_dir_shows_it() -> None:
    assert not [name for name in sg.__all__ if name.startswith("_")]
    assert set(sg.__all__) <= set(dir(sg))


def test_importing_every_submodule_hides_no_public_name() -> None:
    for module in pkgutil.walk_packages(sg.__path__, "splatgraft."):
        if module.name == "splatgraft.__main__":
            continue
        try:
            importlib.import_module(module.name)
        except ImportError as error:
            # optional libraries that are not installed here (gsplat, ..); ours must load
            if (error.name or "splatgraft").startswith("splatgraft"):
                raise
    assert not [name for name in sg.__all__ if inspect.ismodule(getattr(sg, name))]


def test_an_unknown_name_is_an_attribute_error() -> None:
    assert not hasattr(sg, "relit")


if __name__ == "__main__":
    RECORDED.write_text(api())
