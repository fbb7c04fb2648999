"""The wheel holds all files that the installed package reads: captures of the demo, the report's page."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Return the names of the files in a wheel built from this tree."""
    out = tmp_path_factory.mktemp("wheel")
    # from a copy, because a build leaves folders beside the sources
    tree = out / "tree"
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True).stdout
    for name in tracked.decode().rstrip("\0").split("\0"):
        if name.startswith("src/") or "/" not in name:
            target = tree / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((ROOT / name).read_bytes())
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(out)]
    subprocess.run([*build, str(tree)], check=True)
    (wheel,) = out.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_every_file_of_the_package_is_in_the_wheel(names: set[str]) -> None:
    tracked = subprocess.run(["git", "ls-files", "-z", "src"], cwd=ROOT, check=True, capture_output=True).stdout
    expected = {name.removeprefix("src/") for name in tracked.decode().rstrip("\0").split("\0")}
    assert expected <= names, sorted(expected - names)


def test_the_demo_has_both_captures(names: set[str]) -> None:
    for capture, count in (("bananas", 16), ("table", 28)):
        folder = f"splatgraft/demo_captures/{capture}/"
        assert {folder + "transforms.json", folder + "points.ply", folder + "LICENSE"} <= names
        assert sum(name.startswith(folder + "images/") for name in names) == count
