"""Edits are saved at once and undone without limit; no value in a file or a widget makes a project unopenable."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatgraft.core.similarity import Similarity
from splatgraft.editor.history import History
from splatgraft.editor.photo_view import with_click
from splatgraft.editor.project import Project
from splatgraft.editor.session import Session
from splatgraft.editor.state import EditState, read_state, state_files, write_state
from splatgraft.project.placement import ObjectPlacement
from splatgraft.project.prompts import read_prompts
from splatgraft.project.toml_edit import with_keys
from splatgraft.relighting import LayerWeights, light_to_json
from splatgraft.relighting.light.light import Light, LightSource, fit_ambient
from splatgraft.runtime.settings import MAX_TEXT_BYTES, read_toml
from splatgraft.workflow.flow import read_flow

LIGHT = Light(
    sources=(LightSource(direction=(0.0, 0.6, 0.8), irradiance=(2.0, 2.0, 2.0), name="sun"),),
    ambient=fit_ambient(torch.tensor([0.3, 0.3, 0.4])),
)
BOX = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)


def contents(session: Session) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in state_files(session.files.file) if path.is_file()}


def moved(state: EditState) -> EditState:
    assert state.objects is not None
    move = replace(state.objects[0].target_from_object, translation=torch.tensor([0.1, 0.2, 0.3]))
    return state.with_object(0, ObjectPlacement(move))


def without_empty(text: bytes) -> bytes:
    return text.replace(b"\n[harmonize]\n", b"").replace(b"\n[relight]\n", b"")


def test_every_edit_is_saved_and_undone_also_after_a_restart(session: Session) -> None:
    assert [item.object_path for item in session.objects()] == [None]
    target = session.scenes.scene("target").count
    source = session.scenes.scene("source").count
    erased, corrections = torch.arange(target) % 7 == 0, (torch.arange(source) % 3 - 1).to(torch.int8)
    points = with_click(None, "a.jpg", (10.5, 20.25), on_object=True, longer_side=1000)
    steps = (
        lambda s: moved(session.placed_state()),
        lambda s: replace(s, erased=erased),
        lambda s: replace(s, corrections=corrections),
        lambda s: replace(s, prompts=points),
        lambda s: replace(s, light=LIGHT),
        lambda s: replace(s, weights=LayerWeights(shadow=0.5, gloss=0.0, exposure=-0.5)),
        lambda s: replace(s, box=BOX, mask_source="grabcut", keep="largest"),
        lambda s: replace(s, harmonizer="none"),
    )
    seen = [contents(session)]
    for step in steps:
        session.change(step(session.state))
        seen.append(contents(session))
    again = read_state(session.files.file)
    assert again.objects is not None
    assert again.erased is not None
    assert again.corrections is not None
    assert again.light is not None
    assert again.objects[0].target_from_object.translation.tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert torch.equal(again.erased, erased)
    assert torch.equal(again.corrections, corrections)
    assert light_to_json(again.light) == light_to_json(LIGHT)
    assert again.weights == LayerWeights(shadow=0.5, gloss=0.0, exposure=-0.5)
    assert (again.box, again.mask_source, again.keep, again.harmonizer) == (BOX, "grabcut", "largest", "none")
    # an unchanged state is no step
    session.change(replace(session.state, keep="largest"))
    # the steps accept the edited project
    read_flow(session.files.file)
    opened = Session(session.project)
    for wanted in reversed(seen[:-1]):
        assert opened.step(-1)
        found = contents(opened)
        for name in wanted:
            # a file that project.toml no longer names may stay, and a table that was made for a key, empty
            assert without_empty(found[name]) == without_empty(wanted[name]), name
    assert not opened.step(-1)
    while opened.step(1):
        pass
    assert contents(opened) == seen[-1]
    assert opened.state.prompts is not None
    assert points is not None
    assert torch.equal(opened.state.prompts["a.jpg"].inside, points["a.jpg"].inside)


def test_a_change_while_no_editor_was_open_is_a_step_and_a_damaged_history_begins_anew(session: Session) -> None:
    for keep in ("largest", "all"):
        session.change(replace(session.state, keep=keep))
    session.step(-1)
    file, folder = session.files.file, session.files.root / ".editor"
    write_state(file, session.state, replace(session.state, harmonizer="none"))
    again = Session(session.project)
    assert again.state.harmonizer == "none"
    # states outside the history are deleted
    kept = {path.stem for path in (folder / "states").iterdir()}
    assert {*again.history.names} <= kept
    assert again.step(-1)
    assert again.state.harmonizer is None
    # a state that was changed on disk is refused, and nothing is written
    path = folder / "states" / f"{again.history.names[again.history.at - 1]}.json"
    path.write_text(path.read_text().replace("null", "true"))
    before, reopened = contents(session), Session(session.project)
    with pytest.raises(ValueError, match="expected an earlier state"):
        reopened.step(-1)
    assert contents(session) == before
    (folder / "history.json").write_text("{")
    assert not Session(session.project).step(-1)


@given(st.lists(st.text()), st.text())
def test_undoing_all_gives_the_first_value_and_redoing_all_the_last(names: list[str], other: str) -> None:
    history = History(("first",))
    for name in names:
        history = history.pushed(name)
    back = history
    for _ in names:
        back = back.moved(-1)
    assert back.present == "first"
    assert back.moved(-1) is back
    # a new step discards undone ones
    assert back.pushed(other).moved(1) == back.pushed(other)
    for _ in names:
        back = back.moved(1)
    assert back == history
    assert back.moved(1) is back


def test_outside_changes_are_loaded_as_an_undo_step(session: Session) -> None:
    session.change(replace(session.state, keep="substantial"))
    assert not session.reload()
    outside = read_state(session.files.file)
    write_state(session.files.file, outside, replace(outside, keep="all"))
    with pytest.raises(ValueError, match="outside"):
        session.change(replace(session.state, keep="largest"))
    assert session.state.keep == "all"
    session.change(replace(session.state, keep="largest"))
    assert read_state(session.files.file).keep == "largest"
    session.step(-1)
    session.step(-1)
    assert read_state(session.files.file).keep == "substantial"


def test_points_by_hand_are_kept_and_continued_and_broken_ones_named(session: Session) -> None:
    project = session.files.file
    by_hand = project.parent / "mine.toml"
    by_hand.write_text('["a.jpg"]\nbox = [1, 2, 30, 40]\n')
    project.write_text(with_keys(project.read_text(), "segment", {"prompts": "mine.toml"}))
    assert session.reload()
    points = with_click(session.state.prompts, "b.jpg", (5.0, 5.0), on_object=False, longer_side=100)
    session.change(replace(session.state, prompts=points))
    assert 'prompts = "prompts.json"' in project.read_text()
    stored = read_prompts(project.parent / "prompts.json")
    assert stored["a.jpg"].box == (1, 2, 30, 40)
    assert len(stored["b.jpg"].outside) == 1
    assert by_hand.read_text() == '["a.jpg"]\nbox = [1, 2, 30, 40]\n'
    assert session.step(-1)
    assert list(read_state(project).prompts or {}) == ["a.jpg"]
    session.step(1)
    (project.parent / "prompts.json").write_text('{"a.jpg": {"inside": [[1]]}}')
    with pytest.raises(ValueError, match=r"prompts\.json: a\.jpg: expected inside = "):
        session.reload()


def placed(scale: Any = 1.0, translation: Any = (0.0, 0.0, 0.0)) -> EditState:
    return EditState(objects=(ObjectPlacement(Similarity(scale, torch.eye(3), torch.tensor(translation))),))


def lit(irradiance: float) -> Light:
    return Light((LightSource((0.0, 0.0, 1.0), (irradiance, 1.0, 1.0)),), fit_ambient(torch.ones(3)))


BAD_STATES = {
    "scale 0": placed(scale=0.0),
    "scale nan": placed(scale=math.nan),
    "scale large": placed(scale=1e30),
    "position inf": placed(translation=(0.0, math.inf, 0.0)),
    "box nan": EditState(box=(0.0, 0.0, 0.0, 1.0, 1.0, math.nan)),
    # these corners are in order, but not in float32
    "box flat": EditState(box=(5e5, 0.0, 0.0, 5e5 + 1e-4, 1.0, 1.0)),
    "light": EditState(light=lit(math.nan)),
}


def test_no_bad_state_is_saved(session: Session) -> None:
    before = contents(session)
    for name, bad in BAD_STATES.items():
        with pytest.raises(ValueError, match=r"expected [^\n]*found [^\n]*$"):
            session.change(bad)
        assert contents(session) == before, name


BAD_PLACEMENTS = [
    *(f'{{"objects": [{{"scale": {value}}}]}}' for value in ("0", "NaN", "1e300", '"x"', "9" * 400)),
    *(f'{{"objects": [{{"rotation": {value}}}]}}' for value in ("[0, 0, 0, 0]", "[NaN, 0, 0, 1]", "7")),
    '{"objects": [{"translation": [0, 1e300, 0]}]}',
    '{"objects": 7}',
    '{"objects": [], "erased": "nothing.npy"}',
    '{"objects": [{"object": 7}]}',
    "[" * 100_000,
    "\udc80",
    "",
]


def test_a_file_that_cannot_be_read_is_named_and_stays_until_it_is_corrected(session: Session) -> None:
    session.change(replace(session.placed_state(), keep="largest"))
    file = session.files.file.parent / "placement.json"
    good = file.read_bytes()
    for text in BAD_PLACEMENTS:
        content = text.encode("utf-8", "surrogateescape")
        file.write_bytes(content)
        # a running editor and a starting one name the error in one line, and write nothing
        for attempt in (
            session.reload,
            lambda: session.step(-1),
            lambda: session.change(EditState()),
            lambda: Session(session.project),
        ):
            with pytest.raises(ValueError, match=r"^[^\n]*(placement\.json|nothing\.npy)[^\n]*$"):
                attempt()
        assert file.read_bytes() == content
        assert session.state.keep == "largest"
    file.write_bytes(good)
    session.reload()
    assert session.step(-1)
    assert session.state.keep == "all"


def test_settings_refuse_huge_files_and_deep_nesting_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "project.toml"
    with file.open("wb") as stream:
        stream.truncate(MAX_TEXT_BYTES + 1)
    with pytest.raises(ValueError, match="at most 16 MiB of TOML"):
        read_toml(file)
    file.write_text("x = " + "[" * 50_000)
    with pytest.raises(ValueError, match="nested too deeply"):
        read_toml(file)


def test_a_project_with_trained_scenes_names_them(session: Session, tmp_path: Path) -> None:
    made = Project(tmp_path / "new" / "project.toml")
    captures = (session.files.cameras["source"].parent, session.files.cameras["target"].parent)
    with pytest.raises(ValueError, match="trained scene"):
        made.create(captures, scenes=(tmp_path / "none.ply", None))
    made.create(captures, scenes=(session.files.scenes["source"], None))
    files = made.files()
    assert files.has_photos("source")
    assert files.has_photos("target")
    given = read_toml(made.file)["source"]["scene"]
    assert (made.file.parent / given).resolve() == session.files.scenes["source"].resolve()


def test_erased_flags_of_another_target_are_named(session: Session) -> None:
    session.change(session.placed_state())
    file = session.files.file.parent / "placement.json"
    np.save(file.parent / "erased.npy", np.zeros(3, bool))
    file.write_text(json.dumps(json.loads(file.read_text()) | {"erased": "erased.npy"}))
    assert session.reload()
    with pytest.raises(ValueError, match="erased"):
        session.scenes.composite(session.state)
