"""The Dockerfile as far as it can be checked without Docker: its files, stages, packages and commands exist."""

import json
import re
import shlex
import tomllib
from pathlib import Path

import tyro

from splatgraft.cli import COMMANDS
from splatgraft.commands.edit import Edit

ROOT = Path(__file__).parents[1]
DEVICES = ("cpu", "cuda")


def instructions() -> list[tuple[str, str]]:
    """Keyword and rest of each instruction, continued lines joined."""
    lines = (ROOT / "Dockerfile").read_text().replace("\\\n", " ").splitlines()
    kept = [line.strip() for line in lines if line.strip() and not line.startswith("#")]
    return [(keyword, rest.strip()) for keyword, _, rest in (line.partition(" ") for line in kept)]


def of(keyword: str) -> list[str]:
    return [rest for found, rest in instructions() if found == keyword]


def test_every_instruction_is_one_of_docker_s() -> None:
    known = {"ARG", "FROM", "ENV", "RUN", "WORKDIR", "COPY", "USER", "VOLUME", "EXPOSE", "ENTRYPOINT", "CMD"}
    assert {keyword for keyword, _ in instructions()} <= known
    for command in of("RUN"):
        assert shlex.split(command)


def test_each_device_is_a_stage_and_the_default_is_the_cpu() -> None:
    arguments = dict(rest.split("=") for rest in of("ARG"))
    stages = of("FROM")
    assert [stage.rpartition(" AS ")[2] for stage in stages[:-1]] == list(DEVICES)
    assert stages[-1] == "${DEVICE}"
    assert arguments["DEVICE"] == "cpu"
    assert all(name in arguments for name in re.findall(r"\$\{(\w+)\}", " ".join(stages)))


def test_copied_files_exist_and_are_not_ignored() -> None:
    lines = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and not line.startswith("#")]
    assert lines[0] == "*"
    let_in = {line.removeprefix("!") for line in lines if line.startswith("!")}
    sources = [word for rest in of("COPY") for word in rest.split()[:-1]]
    assert sources
    for source in sources:
        assert (ROOT / source).exists(), source
        assert source in let_in, source
    assert let_in == set(sources)


def test_packages_and_commands_exist() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = re.findall(r"\bEXTRAS=(\S+)", " ".join(of("ENV")))
    assert len(extras) == len(DEVICES)
    assert {name for group in extras for name in group.split(",")} <= set(project["optional-dependencies"])
    assert json.loads(of("ENTRYPOINT")[-1]) == ["splatgraft"]
    assert "splatgraft" in project["scripts"]
    command, *words = json.loads(of("CMD")[-1])
    assert command in COMMANDS
    options = tyro.cli(Edit, args=words, config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff))
    assert options.projects == (Path("/projects"),)
    assert (options.host, str(options.port)) == ("0.0.0.0", of("EXPOSE")[-1])
    assert of("VOLUME") == ["/projects"]


def test_it_does_not_run_as_root() -> None:
    keywords = [keyword for keyword, _ in instructions()]
    assert of("USER")[-1] != "root"
    assert keywords.index("USER") < keywords.index("ENTRYPOINT")
