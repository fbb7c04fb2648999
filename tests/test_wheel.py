"""The wheel alone: its files, the page that PyPI makes of it, and the workflows' commands in an empty environment."""

import email
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from splatgraft.cli import commands

ROOT = Path(__file__).parents[1]
WORKFLOWS = ROOT / ".github" / "workflows"


def workflow(name: str) -> dict[str, Any]:
    return yaml.safe_load((WORKFLOWS / name).read_text(encoding="utf-8"))


def run_lines(name: str) -> Iterator[str]:
    """Yield the lines of all `run` steps of a workflow, with continued lines joined."""
    for job in workflow(name)["jobs"].values():
        for step in job["steps"]:
            yield from step.get("run", "").replace("\\\n", " ").splitlines()


@pytest.mark.parametrize("name", sorted(path.name for path in WORKFLOWS.glob("*.yml")))
def test_a_workflow_s_commands_exist(name: str) -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    lines = list(run_lines(name))
    assert lines
    for line in lines:
        program, *words = shlex.split(re.sub(r"\$\{\{.*?\}\}", "", line))
        if program == "make":
            assert words[0] in targets, line
        elif program == "splatgraft":
            assert words[0] in commands(), line
        elif "/" in program:
            assert os.access(ROOT / program, os.X_OK), line
        else:
            assert program in ("python", "sudo"), line
    for job in workflow(name)["jobs"].values():
        assert set([job["needs"]] if "needs" in job else []) <= set(workflow(name)["jobs"])
        assert all(("run" in step) != ("uses" in step) for step in job["steps"])
        assert all(
            re.fullmatch(r"[\w-]+/[\w-]+@(v\d+|release/v1)", one["uses"]) for one in job["steps"] if "uses" in one
        )


def test_only_the_repository_that_pypi_names_publishes() -> None:
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]
    publish = workflow("release.yml")["jobs"]["publish"]
    assert urls["Repository"] == "https://github.com/" + re.findall(r"repository == '(.+)'", publish["if"])[0]
    # what trusted publishing needs
    assert publish["permissions"] == {"id-token": "write"}
    assert publish["environment"]["name"] == "pypi"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a wheel from this tree."""
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
    return wheel


@pytest.fixture(scope="module")
def names(wheel: Path) -> set[str]:
    """Return the names of the files in the wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.mark.long
def test_every_file_of_the_package_is_in_the_wheel(names: set[str]) -> None:
    tracked = subprocess.run(["git", "ls-files", "-z", "src"], cwd=ROOT, check=True, capture_output=True).stdout
    expected = {name.removeprefix("src/") for name in tracked.decode().rstrip("\0").split("\0")}
    assert expected <= names, sorted(expected - names)


@pytest.mark.long
def test_the_demo_has_both_captures(names: set[str]) -> None:
    for capture, count in (("bananas", 16), ("table", 28)):
        folder = f"splatgraft/demo_captures/{capture}/"
        assert {folder + "transforms.json", folder + "points.ply", folder + "LICENSE"} <= names
        assert sum(name.startswith(folder + "images/") for name in names) == count


@pytest.mark.long
def test_links_and_pictures_of_the_page_on_pypi_are_absolute(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        found = email.message_from_bytes(archive.read(name))
    assert found["Description-Content-Type"] == "text/markdown"
    address = next(url.split(", ")[1] for url in found.get_all("Project-URL", []) if url.startswith("Repository, "))
    page, own = found.get_payload(), (ROOT / "README.md").read_text(encoding="utf-8")
    links, before = (re.findall(r"\]\(([^)]+)\)", text) for text in (page, own))
    assert len(links) == len(before)
    for link, given in zip(links, before, strict=True):
        if link != given:
            kind = "raw" if Path(given).suffix in (".jpg", ".png", ".svg") else "blob"
            assert link == f"{address}/{kind}/main/{given}"
            assert (ROOT / given).exists(), given
        assert link.startswith("https://"), link


NO_NETWORK = """
import sys


def refuse(event, arguments):
    if event == "socket.getaddrinfo" or (event == "socket.connect" and isinstance(arguments[1], tuple)):
        raise OSError("this environment has no network")


sys.addaudithook(refuse)
"""


@pytest.mark.long
def test_the_installed_wheel_makes_a_transfer_without_a_checkout_and_a_network(wheel: Path, tmp_path: Path) -> None:
    """Run the commands of release.yml. The dependencies are those of the running environment, the package is not."""
    venv.create(tmp_path / "env", symlinks=os.name != "nt")
    python = tmp_path / "env" / ("Scripts" if os.name == "nt" else "bin") / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-index", "--no-deps"]
    subprocess.run([*pip, str(wheel)], check=True)
    ask = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    site = Path(subprocess.run(ask, check=True, capture_output=True, text=True).stdout.strip())
    # a folder that is named here adds its packages, but not what its own .pth files add: no checkout
    (site / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\nimport no_network\n")
    (site / "no_network.py").write_text(NO_NETWORK)
    # kernels of the same sources, compiled by other tests; numba compares the sources
    for compiled in (ROOT / "src" / "splatgraft").rglob("*.nb[ci]"):
        target = site / compiled.relative_to(ROOT / "src")
        target.parent.mkdir(exist_ok=True)
        shutil.copyfile(compiled, target)
    empty = tmp_path / "empty"
    empty.mkdir()
    given = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def said_by(*words: str) -> str:
        done = subprocess.run(words, cwd=empty, env=given, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert Path(said_by(str(python), "-c", "import splatgraft; print(splatgraft.__file__)")).is_relative_to(site)
    smoke = [shlex.split(line) for line in run_lines("release.yml") if line.startswith("splatgraft ")]
    assert [words[1] for words in smoke] == ["doctor", "demo", "demo"]
    *_, said = (said_by(str(python.with_name("splatgraft")), *words) for _, *words in smoke)
    assert said.splitlines()[-1] == str(Path("splatgraft_demo", "report", "index.html"))
    assert (empty / "splatgraft_demo" / "result" / "scene.ply").is_file()
