"""Gives the README that PyPI shows absolute links, because none of the files beside it are there."""

import re
import tomllib
from pathlib import Path

from setuptools import setup

FOLDER = Path(__file__).parent
REPOSITORY = tomllib.loads((FOLDER / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]["Repository"]


def absolute(link: re.Match[str]) -> str:
    """Return the link with the address of its file in the repository."""
    kind = "raw" if link[1].endswith((".jpg", ".png", ".svg")) else "blob"
    return f"]({REPOSITORY}/{kind}/main/{link[1]})"


README = (FOLDER / "README.md").read_text(encoding="utf-8")
setup(
    long_description=re.sub(r"\]\((?!\w+:|#)([^)\s]+)\)", absolute, README),
    long_description_content_type="text/markdown",
)
