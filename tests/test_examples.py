"""The examples run unchanged and without warnings."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9]*.py"))
LONG = ("02_segment", "04_project", "05_several_objects")


@pytest.mark.parametrize(
    "example", [pytest.param(one, id=one.stem, marks=pytest.mark.long if one.stem in LONG else ()) for one in EXAMPLES]
)
def test_an_example_runs(example: Path) -> None:
    runpy.run_path(str(example), run_name="__main__")
