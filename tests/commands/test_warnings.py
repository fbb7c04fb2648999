"""Every warning of a run is in step.json of its step and, with its picture, at the top of the report."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from pathlib import Path

import pytest
import torch
from PIL import Image
from test_relight_step import exposed, fixed
from tiny_project import ball, photograph, plane, write_project

from splatgraft.cli import main
from splatgraft.core.similarity import Similarity
from splatgraft.project.placement import ObjectPlacement, Placement, write_placement
from splatgraft.project.record import read_record
from splatgraft.project.step import Context, Inputs, perform
from splatgraft.runtime.console import Console
from splatgraft.runtime.note import Note
from splatgraft.workflow.flow import read_flow


@dataclass(frozen=True)
class Doubtful:
    """Step that warns with its own picture and with a photo elsewhere."""

    photo: Path
    out: Path

    def inputs(self) -> Inputs:
        return {}

    def write(self, folder: Path, context: Context) -> None:
        Image.new("RGB", (4, 3)).save(folder / "doubt.png")
        context.console.tell(
            Note("A fact."),
            Note("This may be wrong.", "warning", picture=folder / "doubt.png"),
            Note("So may this.", "warning", "Mend it.", self.photo),
            Note("Or all of it.", "warning"),
            Note("This was mended.", "minor"),
        )


def test_a_warning_is_recorded_with_its_picture_relative_to_the_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    console = Console()
    console.tell(Note("Before any step.", "warning"))
    perform(Doubtful(tmp_path / "photos" / "a.jpg", tmp_path / "out"), console)
    record = read_record(tmp_path / "out")
    assert record is not None
    assert record.warnings == (
        Note("This may be wrong.", "warning", picture=Path("doubt.png")),
        Note("So may this.", "warning", "Mend it.", Path("../photos/a.jpg")),
        Note("Or all of it.", "warning"),
        Note("This was mended.", "minor"),
    )
    lines = capsys.readouterr().err.splitlines()
    assert len([line for line in lines if line.startswith("warning: ")]) == 5
    assert "A fact." in lines
    assert "warning: So may this. Mend it." in lines


def test_the_report_begins_with_all_warnings_of_the_run(
    copy_project: Callable[[], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    # nothing was captured around the object, so no light can be found
    warned = copy_project() / "project.toml"
    warned.write_text(warned.read_text().replace('light = "off"', 'light = "transfer"'))
    far = Similarity(1.0, torch.eye(3), torch.tensor([500.0, 0.0, 0.0]))
    write_placement(warned.parent / "placement.json", Placement(objects=(ObjectPlacement(target_from_object=far),)))
    assert main(["run", str(warned)]) == 0
    capsys.readouterr()
    layout = read_flow(warned).layout
    relit = read_record(layout.relit)
    assert relit is not None
    assert [warning for warning in relit.warnings if "is pasted as it is." in warning.text]
    page = (layout.report / "index.html").read_text()
    top = page.split('<section class="warnings">')[1].split("</section>")[0]
    assert page.index('<section class="warnings">') < page.index('<section id="viewer"')
    records = [read_record(step.out) for _, step in read_flow(warned)]
    warnings = [warning for record in records if record is not None for warning in record.warnings]
    assert all(escape(warning.text) in top for warning in warnings)
    assert top.count("<li>") == len(warnings)
    assert "step Light" in top
    with Image.open(layout.report / "warnings" / f"{len(warnings) - 1:02d}.webp") as picture:
        assert picture.size == (48, 36)
    assert main(["status", str(warned)]) == 0
    assert "stale" not in capsys.readouterr().out
    # a report that lacks a warning is stale
    step_file = layout.relit / "step.json"
    step_file.write_text(step_file.read_text().replace("is pasted as", "was pasted as"))
    assert main(["status", str(warned)]) == 0
    stale = [line for line in capsys.readouterr().out.splitlines() if "stale" in line]
    assert [line.split()[0] for line in stale] == ["evaluate"]


@pytest.mark.long
def test_a_side_without_photos_is_warned_of_with_a_picture_of_the_directions(
    copy_project: Callable[[], Path],
) -> None:
    path = copy_project() / "project.toml"
    source = path.parents[1] / "photos" / "source"
    shutil.rmtree(source)
    photograph(source, plane((0.3, 0.5, 0.3)), ball(), around_deg=150.0)
    assert main(["run", str(path), "--to", "compose"]) == 0
    layout = read_flow(path).layout
    for folder, said in ((layout.object, "was never photographed"), (layout.composite, "none of its photos shows")):
        record = read_record(folder)
        assert record is not None
        (warning,) = (warning for warning in record.warnings if said in warning.text)
        assert warning.in_doubt
        assert warning.picture is not None
        with Image.open(folder / warning.picture) as picture:
            assert picture.size == (320, 320)


def test_exposures_are_warned_of_once_in_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_project(tmp_path, "[reconstruct]\niterations = 2\nbudget = 100\n")
    for side in ("source", "target"):
        exposed(tmp_path / "photos" / side, [fixed(1 / 60), fixed(1 / 15)])
    assert main(["run", str(path), "--to", "reconstruct"]) == 0
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if "expected one exposure" in line]
    assert len(said) == 2
    assert len(set(said)) == 2
    # the device is missing too, because all steps share it
    assert sum(line.startswith("device: ") for line in lines) == 1
