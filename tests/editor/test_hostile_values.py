"""No value in a widget or a file may make a project unopenable: it is named, the rest opens, undo goes past it."""

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
import pytest
import torch
from test_scenes_without_photos import AROUND_THE_BALL, scene_project
from test_typed_numbers import arrives, is_handled
from waiting import wait_until

from splatgraft.cli import main
from splatgraft.commands.edit_project import FlowProject
from splatgraft.core.similarity import Similarity
from splatgraft.editor.access.access_control import AccessControl
from splatgraft.editor.jobs.jobs import Jobs, JobState
from splatgraft.editor.page.page import Page, PageOptions
from splatgraft.editor.page.server import GuardedServer
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.session import Session
from splatgraft.editor.session.state_checks import MASK_SOURCES
from splatgraft.editor.session.state_files import read_state
from splatgraft.project.toml_edit import with_keys
from splatgraft.folders.object_masks import MaskSource
from splatgraft.formats.placement import ObjectPlacement
from splatgraft.relighting import LayerWeights
from splatgraft.relighting.light.light import Light, LightSource, fit_ambient
from splatgraft.runtime.settings import MAX_TEXT_BYTES, read_toml


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("hostile")
    project = scene_project(root, suffix=".ply", box=AROUND_THE_BALL, mask_source="box")
    assert main(["run", str(project), "--to", "compose"]) == 0
    return root


@pytest.fixture
def project(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy" / "project" / "project.toml"


@pytest.fixture
def session(project: Path) -> Session:
    return Session(FlowProject(project))


def page_of(project: Path) -> tuple[Page, Callable[[], None]]:
    guarded = GuardedServer(AccessControl("secret"), host="127.0.0.1", port=0)
    page = Page(guarded, FlowProject(project), PageOptions(budget=1000, inside=None))

    def close() -> None:
        page.close()
        guarded.close()

    return page, close


def placed(scale: Any = 1.0, rotation: Any = None, translation: Any = (0.0, 0.0, 0.0)) -> EditState:
    turn = torch.eye(3) if rotation is None else rotation
    move = Similarity(scale=scale, rotation=turn, translation=torch.tensor(translation))
    return EditState(objects=(ObjectPlacement(move),))


def lit(irradiance: float) -> Light:
    return Light((LightSource((0.0, 0.0, 1.0), (irradiance, 1.0, 1.0)),), fit_ambient(torch.ones(3)))


BAD_STATES = [
    *(placed(scale=value) for value in (0.0, -1.0, math.nan, math.inf, 1e30, 1e-30)),
    *(placed(rotation=turn) for turn in (torch.zeros(3, 3), torch.full((3, 3), math.nan), -torch.eye(3))),
    placed(rotation=2 * torch.eye(3)),
    *(placed(translation=(0.0, value, 0.0)) for value in (math.nan, math.inf, 1e30)),
    EditState(box=(0.0, 0.0, 0.0, 1.0, 1.0, math.nan)),
    EditState(box=(0.0, 0.0, 0.0, 1.0, 1.0, 0.0)),
    # these corners are in order, but not in float32
    EditState(box=(5e5, 0.0, 0.0, 5e5 + 1e-4, 1.0, 1.0)),
    EditState(mask_source="bogus"),
    EditState(keep="bogus"),
    EditState(harmonizer="bogus"),
    *(EditState(weights=LayerWeights(shadow=value)) for value in (math.nan, math.inf, -1.0, 1e9)),
    *(EditState(weights=LayerWeights(exposure=value)) for value in (math.nan, -math.inf, -17.0)),
    EditState(light=lit(math.nan)),
    EditState(light=lit(-1.0)),
]


@pytest.mark.parametrize("bad", BAD_STATES, ids=range(len(BAD_STATES)))
def test_no_bad_state_is_saved(session: Session, bad: EditState) -> None:
    folder = session.files.file.parent
    before = {path: path.read_bytes() for path in folder.glob("*") if path.is_file()}
    for save in (session.change, session.amend):
        with pytest.raises(ValueError, match=r"expected [^\n]*found [^\n]*$"):
            save(bad)
    assert {path: path.read_bytes() for path in folder.glob("*") if path.is_file()} == before
    Session(session.project)


def test_the_names_of_mask_sources_are_those_of_the_step() -> None:
    assert get_args(MaskSource) == MASK_SOURCES


BAD_PLACEMENTS = [
    *(
        f'{{"objects": [{{"scale": {value}}}]}}'
        for value in ("0", "-1", "NaN", "Infinity", "1e300", '"x"', "[]", "9" * 400)
    ),
    *(f'{{"objects": [{{"rotation": {value}}}]}}' for value in ("[0, 0, 0, 0]", "[NaN, 0, 0, 1]", "7", "[[1]]")),
    '{"objects": [{"translation": [0, 1e300, 0]}]}',
    '{"objects": 7}',
    '{"objects": [], "erased": 7}',
    '{"objects": [], "erased": "nothing.npy"}',
    '{"objects": [{"object": 7}]}',
    "[" * 100_000,
    "\udc80",
    "",
]


@pytest.mark.parametrize("text", BAD_PLACEMENTS, ids=range(len(BAD_PLACEMENTS)))
def test_a_bad_placement_is_named_and_undo_goes_past_it(session: Session, text: str) -> None:
    session.change(replace(session.placed_state(), keep="largest"))
    good = session.state
    file = session.files.file.parent / "placement.json"
    file.write_bytes(text.encode("utf-8", "surrogateescape"))
    again = Session(session.project)
    assert again.notice is not None
    assert "placement.json" in again.notice or "nothing.npy" in again.notice
    assert "\n" not in again.notice
    # the rest is open
    assert again.state.keep == "largest"
    assert file.read_bytes() == text.encode("utf-8", "surrogateescape")
    assert again.undo()
    found = read_state(again.files.file)
    assert found.objects is not None
    assert good.objects is not None
    assert torch.equal(found.objects[0].target_from_object.translation, good.objects[0].target_from_object.translation)
    kept = session.files.root / ".editor" / "broken" / "placement.json"
    assert kept.read_bytes() == text.encode("utf-8", "surrogateescape")
    assert Session(session.project).notice is None


def test_a_file_that_turns_bad_while_the_editor_is_open_is_named_once_and_undone(session: Session) -> None:
    session.change(session.placed_state())
    file = session.files.file.parent / "placement.json"
    good = file.read_text()
    file.write_text('{"objects": [{"scale": 0}]}')
    with pytest.raises(ValueError, match="scale above 0"):
        session.reload()
    assert not session.reload()
    assert session.undo()
    assert json.loads(file.read_text()) == json.loads(good)
    # an edit replaces a bad file as well
    file.write_text("{")
    with pytest.raises(ValueError, match="expected JSON"):
        session.reload()
    session.change(replace(session.state, keep="all"))
    assert json.loads(file.read_text()) == json.loads(good)


BAD_TABLES = [
    "[relight]\nshadow = nan\n",
    '[relight]\nshadow = "x"\n',
    "[relight]\nshadow = [[[]]]\n",
    "[relight]\ngiven_light = 7\n",
    "[compose]\nscale = nan\n",
    '[harmonize]\nmethod = "bogus"\n',
    "segment = 7\n",
    "x = " + "[" * 20_000 + "\n",
    "[relight\n",
    "\x00",
]


@pytest.mark.parametrize("text", BAD_TABLES, ids=range(len(BAD_TABLES)))
def test_the_page_opens_on_a_bad_project_file_and_puts_the_last_good_one_back(project: Path, text: str) -> None:
    Session(FlowProject(project))
    good = project.read_text()
    project.write_text(text + good.replace("[compose]", "[other]") if text[:2] == "x " else good + text)
    page, close = page_of(project)
    try:
        assert page.session is None
        assert page.problem is not None
        assert "project.toml" in page.problem
        assert "\n" not in page.problem
        assert page.phase == "Open"
        page.restore_project()
        assert page.session is not None
        assert page.problem is None
        assert project.read_text() == good
        assert (project.parent / ".editor" / "broken" / "project.toml").is_file()
    finally:
        close()


def test_a_corrected_project_file_is_opened_by_itself(project: Path) -> None:
    good = project.read_text()
    project.write_text("[")
    page, close = page_of(project)
    try:
        assert page.session is None
        project.write_text(good)
        page._poll()
        assert page.session is not None
    finally:
        close()


def test_settings_refuse_huge_files_and_deep_nesting_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "project.toml"
    with file.open("wb") as stream:
        stream.truncate(MAX_TEXT_BYTES + 1)
    with pytest.raises(ValueError, match="at most 16 MiB of TOML"):
        read_toml(file)
    file.write_text("x = " + "[" * 50_000)
    with pytest.raises(ValueError, match="nested too deeply"):
        read_toml(file)


def test_undo_passes_over_a_state_that_cannot_be_read(session: Session) -> None:
    for keep in ("largest", "all", "substantial"):
        session.change(replace(session.state, keep=keep))
    second = session.history.past[-1]
    (session.files.root / ".editor" / "states" / f"{second}.json").write_text('{"objects": 7}')
    again = Session(session.project)
    assert again.undo()
    assert again.state.keep == "largest"
    assert again.notice is not None
    assert "left out" in again.notice


def test_erased_flags_of_another_target_leave_the_page_usable(project: Path) -> None:
    session = Session(FlowProject(project))
    session.change(session.placed_state())
    placement = json.loads((project.parent / "placement.json").read_text())
    np.save(project.parent / "erased.npy", np.zeros(3, bool))
    (project.parent / "placement.json").write_text(json.dumps(placement | {"erased": "erased.npy"}))
    page, close = page_of(project)
    try:
        page.show_phase("Place")
        assert "expected one flag per Gaussian of the target" in page._status.content
        place = cast("Any", page._phases["Place"])
        place._restore_all()
        assert read_state(project).erased is None
    finally:
        close()


@pytest.mark.parametrize("value", [0.0, -2.0, math.nan, math.inf])
def test_a_typed_scale_that_cannot_be_is_refused_and_shown_again_as_it_was(project: Path, value: Any) -> None:
    page, close = page_of(project)
    try:
        page.show_phase("Place")
        place = cast("Any", page._phases["Place"])
        scale = place._scale.value
        arrives(place._scale, value)
        is_handled(place._scale)
        assert "expected a number" in page._status.content
        assert place._scale.value == scale
        Session(FlowProject(project))
    finally:
        close()


@pytest.mark.parametrize("text", ["{", "7", '{"pid": 0}', json.dumps(JobState("a", (), 0, "running", 0.0).__dict__)])
def test_a_damaged_job_file_does_not_prevent_another_job(tmp_path: Path, text: str) -> None:
    (tmp_path / "job.json").write_text(text)
    jobs = Jobs(tmp_path)
    with pytest.raises(ValueError, match="expected the state of a job"):
        jobs.state()
    jobs.start(["true"], title="next", shown=())

    def has_ended() -> bool:
        state = jobs.state()
        return state is not None and state.title == "next" and not state.live

    wait_until(has_ended, what="the end of the job")


def test_a_broken_key_of_the_editor_in_a_readable_project_is_replaced_by_undo(session: Session) -> None:
    file = session.files.file
    session.change(replace(session.state, box=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0)))
    file.write_text(with_keys(file.read_text(), "relight", {"given_light": "light.json"}))
    (file.parent / "light.json").write_text('{"format": "splatgraft light 1"}')
    again = Session(session.project)
    assert again.notice is not None
    assert "light.json" in again.notice
    assert again.state.box == (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    assert again.undo()
    assert "given_light" not in read_toml(file)["relight"]
