"""`splatgraft try` on generated captures: no question, a report at the end, and the next steps."""

import os
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image
from tiny_project import ball, photograph, plane

from splatgraft.cli import main
from splatgraft.commands import first_try
from splatgraft.commands.first_try import refinements
from splatgraft.project.record import Record, read_record, write_record
from splatgraft.runtime.note import Note
from splatgraft.segmentation import SolidifyOptions
from splatgraft.steps import segment
from splatgraft.workflow.flow import read_flow


@pytest.fixture
def captures(tmp_path: Path) -> tuple[str, str]:
    photograph(tmp_path / "ball" / "images_", plane((0.3, 0.5, 0.3)), ball())
    photograph(tmp_path / "room", plane((0.5, 0.45, 0.6)), None)
    return str(tmp_path / "ball" / "images_"), str(tmp_path / "room")


def test_a_first_transfer_needs_nothing_but_two_captures(
    captures: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    # a desktop that opens pages: a program that records its arguments
    opener = tmp_path / "bin" / "xdg-open"
    opener.parent.mkdir()
    opener.write_text('#!/bin/sh\necho "$1" > opened.txt\n')
    opener.chmod(0o755)
    monkeypatch.setenv("PATH", f"{opener.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("DISPLAY", ":0")
    assert first_try.DRAFT == {"quality": "draft"}
    monkeypatch.setattr(first_try, "DRAFT", {"quality": "draft", "iterations": 60, "budget": 400})
    monkeypatch.setattr(segment, "SolidifyOptions", lambda steps, **more: SolidifyOptions(min(steps, 60), **more))
    assert main(["try", *captures, "--draft"]) == 0
    printed = capsys.readouterr()
    page = Path("images__into_room") / "report" / "index.html"
    assert printed.out.splitlines()[-1] == str(page)
    assert page.is_file()
    project = tomllib.loads((page.parents[1] / "project.toml").read_text())
    assert project["reconstruct"]["quality"] == "draft"
    assert "segment" not in project  # there are masks
    said = printed.err.splitlines()
    unsure = [line.split(": ")[1] for line in said if line.startswith("unsure: ")]
    flow = read_flow(page.parents[1])
    warnings = {name: record.warnings for name, step in flow if (record := read_record(step.out))}
    assert unsure == [name for name, said in warnings.items() if any(one.in_doubt for one in said)] != []
    assert len([line for line in said if line.startswith("helps most: ") and len(line) > 20]) == 1
    assert "splatgraft run images__into_room" in next(line for line in said if line.startswith("finer: "))
    assert f"{page}: opened in the browser" in said
    # without --draft it continues to a finer result, and does not pose the photos again
    toml = page.parents[1] / "project.toml"
    toml.write_text(toml.read_text() + "# mine\n")
    assert main(["try", *captures, "--keep-closed"]) == 0
    again = capsys.readouterr().err
    assert "opened" not in again
    assert again.index("the draft; the place at standard quality follows") < again.index("target/reconstruct   begins")
    # the object was fitted to its photographs already
    assert "source/reconstruct   begins" not in again
    assert "segment              begins" not in again
    assert "capture       begins" not in again
    assert 'finer: quality = "high"' in again
    assert tomllib.loads(toml.read_text())["reconstruct"]["quality"] == "standard"
    # a third time nothing is stale, and changes of the project file stay
    assert main(["try", *captures, "--keep-closed"]) == 0
    assert "begins" not in capsys.readouterr().err
    assert toml.read_text().endswith("# mine\n")


def test_what_was_mended_is_noted_and_is_not_what_helps_most(
    captures: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, target = captures
    assert main(["init", str(tmp_path / "p"), "--source", source, "--target", target]) == 0
    flow = read_flow(tmp_path / "p")
    (name, first), (_, second), *_ = flow
    left_out = Note("One photo is blurred.", "minor")
    doubt = Note("Half of it is fog.", "warning", "leave the photo out")
    worst = Note("The back is a guess.", "warning", "photograph the back too", Path("coverage.png"))
    last = next(step for name, step in flow if name == "segment")
    for step, warnings in ((first, (left_out, left_out)), (second, (doubt,)), (last, (worst,))):
        step.out.mkdir(parents=True)
        record = Record(type(step).__name__.lower(), "0", {}, {}, (), 0.0, 0, warnings)
        write_record(step.out, record)
    lines = refinements(flow, tmp_path / "p")
    assert lines[0] == f"noted: {name}: One photo is blurred. (and 1 more)"
    assert lines[1].startswith("unsure: ")
    assert lines[1].endswith("Half of it is fog.")
    assert lines[2] == "unsure: segment: The back is a guess."
    # what the picture shows first, although another step comes first
    assert lines[3] == f"worst: The back is a guess. ({last.out / 'coverage.png'})"
    assert lines[4] == "helps most: photograph the back too"
    for step in (second, last):
        write_record(step.out, replace(record, warnings=()))
    assert refinements(flow, tmp_path / "p")[1].startswith("no step warned")


def test_a_project_of_other_captures_is_not_replaced_and_what_does_not_exist_leaves_nothing_behind(
    captures: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, target = captures
    folder = str(tmp_path / "project")
    assert main(["init", folder, "--source", source, "--target", target]) == 0
    text = (tmp_path / "project" / "project.toml").read_text()
    assert main(["try", target, source, "--out", folder]) == 2
    assert "project.toml: expected a project of these captures" in capsys.readouterr().err
    assert (tmp_path / "project" / "project.toml").read_text() == text
    assert main(["try", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "out")]) == 2
    assert f"{tmp_path / 'a'}: expected photos, a video" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_used_and_a_folder_of_the_same_name_are_left_alone(
    captures: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = captures
    monkeypatch.chdir(tmp_path)
    few = tmp_path / "few"
    few.mkdir()
    Image.new("RGB", (30, 20)).save(few / "only.jpg")
    assert main(["try", str(few), target]) == 2
    assert f"{few}: expected at least 8 photos, found 1" in capsys.readouterr().err
    assert not (tmp_path / "few_into_room").exists()
    (tmp_path / "images__into_room").mkdir()
    (tmp_path / "images__into_room" / "letter.txt").write_text("mine")
    began: list[Path] = []
    monkeypatch.setattr(first_try, "run_steps", lambda project, *_, **__: began.append(project))
    for _ in range(2):  # a second time the same project continues
        assert main(["try", source, target, "--keep-closed"]) == 0
    assert began == [Path("images__into_room_2") / "project.toml"] * 3  # draft, standard, and nothing new
    assert [path.name for path in (tmp_path / "images__into_room").iterdir()] == ["letter.txt"]
