"""The command line: one line and exit 2 for errors of the user, and help that names every command."""

import importlib
import tomllib
from pathlib import Path

import pytest

from splatgraft.cli import commands, main
from splatgraft.runtime.optional_dependencies import OPTIONAL_DEPENDENCIES, extra_providing

ROOT = Path(__file__).parents[1]


def test_help_names_every_command_and_every_command_has_a_step(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    for command in commands():
        first = command.split()[0]
        assert f"  {command if first in commands() else first + ' ...'} " in printed
        assert commands()[command].load()


def test_every_file_in_commands_and_steps_is_a_command() -> None:
    folders = [ROOT / "src" / "splatgraft" / name for name in ("commands", "steps")]
    files = {path for folder in folders for path in folder.rglob("*.py") if path.name != "__init__.py"}
    places = [commands()[command].place.partition(":")[0] for command in commands()]
    modules = {Path(importlib.import_module(place).__file__ or "") for place in places if "_paper" not in place}
    assert files == modules


def test_a_group_lists_its_commands_and_refuses_others(capsys: pytest.CaptureFixture[str]) -> None:
    for group in ("paper", "paper synth"):
        inner = [command for command in commands() if command.startswith(f"{group} ")]
        assert main([group, "--help"]) == 0
        printed = capsys.readouterr().out
        assert f"usage: splatgraft {group}" in printed
        assert all(f"  {command} " in printed for command in inner)
        assert main([group, "nonsense"]) == 2
        assert f"found {group} nonsense" in capsys.readouterr().err
        assert main([group]) == 2


def test_each_command_explains_itself(capsys: pytest.CaptureFixture[str]) -> None:
    for command in commands():
        with pytest.raises(SystemExit) as leaving:
            main([*command.split(), "--help"])
        assert leaving.value.code == 0
        assert f"usage: splatgraft {command}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["nonsense"], "splatgraft: expected a command among"),
        (["reconstruct", "{tmp}/nowhere"], "{tmp}/nowhere: expected a capture folder"),
        (["reconstruct", "{tmp}"], "{tmp}: expected transforms.json"),
        (["capture", "{tmp}/nowhere.mp4"], "{tmp}/nowhere.mp4: expected"),
        (["run", "{tmp}"], "{tmp}/project.toml: expected a TOML file, found none"),
        (["status", "{tmp}/other.toml"], "{tmp}/other.toml: expected a TOML file, found none"),
        (["reconstruct", "{tmp}/other.toml"], "{tmp}/other.toml: expected a TOML file, found none"),
        (["render", "--scene", "{tmp}/a.ply", "--cameras", "{tmp}/t.json"], "{tmp}/a.ply: expected"),
        (["harmonize", "{tmp}"], "{tmp}/transforms.json: expected"),
        (["init", "{tmp}/p", "--source", "{tmp}/a", "--target", "{tmp}"], "{tmp}/a: expected photos, a video"),
    ],
)
def test_bad_data_is_one_line_that_names_the_file(
    words: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([word.replace("{tmp}", str(tmp_path)) for word in words]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.splitlines()) == 1
    assert printed.err.startswith("splatgraft: ")
    assert line.replace("{tmp}", str(tmp_path)) in printed.err
    assert "Traceback" not in printed.err
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected a TOML file"):
        main(["run", str(tmp_path), "--debug"])


def test_a_missing_extra_is_named_with_the_command_that_brings_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(words: list[str]) -> int:
        raise ModuleNotFoundError("No module named 'pycolmap.x'", name="pycolmap.x")

    monkeypatch.setattr("splatgraft.cli._dispatch", fail)
    assert main(["status"]) == 2
    assert "pip install 'splatgraft[sfm]'" in capsys.readouterr().err


def test_an_interruption_is_no_crash(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt(words: list[str]) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("splatgraft.cli._dispatch", interrupt)
    assert main(["run"]) == 130
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_extras_are_those_of_the_package() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for name, extra in OPTIONAL_DEPENDENCIES.items():
        for module, package in extra.packages.items():
            assert any(line.lower().startswith(package) for line in declared[name])
            assert extra_providing(f"{module}.inner") == name
    assert set(OPTIONAL_DEPENDENCIES) == set(declared) - {"dev", "docs", "paper"}


def test_doctor_says_what_is_missing_and_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("splatgraft.commands.doctor._version", lambda package: None)
    assert main(["doctor"]) == 0
    printed = capsys.readouterr().out
    for name in OPTIONAL_DEPENDENCIES:
        assert f"missing: pip install 'splatgraft[{name}]'" in printed


def test_init_writes_a_project_that_can_be_read_and_never_replaces_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'so "quoted"').mkdir()
    words = ["init", str(tmp_path / "p"), "--source", str(tmp_path / 'so "quoted"'), "--target", str(tmp_path)]
    assert main(words) == 0
    path = tmp_path / "p" / "project.toml"
    assert capsys.readouterr().out == f"{path}\n"
    content = tomllib.loads(path.read_text())
    assert content == {"source": {"capture": '../so "quoted"'}, "target": {"capture": ".."}}
    assert main(words) == 2
    assert "expected no project here yet" in capsys.readouterr().err
