"""A session without a browser: edits are saved at once, previews equal the results of the steps."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_project import OPTIONS, write_project

from splatgraft.cli import main
from splatgraft.commands.edit_project import FlowProject
from splatgraft.core.images import read_rgb
from splatgraft.core.similarity import Similarity
from splatgraft.editor.previews.preview import PICTURE_KINDS, PictureSize, wipe_comparison
from splatgraft.editor.session import placement_operations
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.session import Session
from splatgraft.editor.session.state_files import read_state, state_files, write_state
from splatgraft.project.toml_edit import with_keys
from splatgraft.formats import read_gaussians
from splatgraft.formats.placement import ObjectPlacement
from splatgraft.project.record import read_record
from splatgraft.relighting import LayerWeights, light_from_json, light_to_json
from splatgraft.relighting.light.light import Light, LightSource, fit_ambient
from splatgraft.workflow.flow import read_flow
from splatgraft.workflow.time_estimate import estimate_step_times

LIGHT = Light(
    sources=(LightSource(direction=(0.0, 0.6, 0.8), irradiance=(2.0, 2.0, 2.0), name="sun"),),
    ambient=fit_ambient(torch.tensor([0.3, 0.3, 0.4])),
)


@pytest.fixture(scope="module")
def apply_output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("session")
    project = write_project(root, OPTIONS.replace('light = "gain"', 'light = "transfer"'))
    assert main(["run", str(project), "--to", "compose"]) == 0
    return project


@pytest.fixture
def session(apply_output: Path, tmp_path: Path) -> Session:
    shutil.copytree(apply_output.parents[1], tmp_path / "copy")
    return Session(FlowProject(tmp_path / "copy" / "project" / "project.toml"))


def contents(session: Session) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in state_files(session.files.file) if path.is_file()}


def moved(state: EditState) -> EditState:
    assert state.objects is not None
    move = replace(state.objects[0].target_from_object, translation=torch.tensor([0.1, 0.2, 0.3]))
    return state.with_object(0, ObjectPlacement(move))


def test_every_edit_is_saved_and_undone(session: Session) -> None:
    assert [item.object_path for item in session.objects()] == [None]
    before = contents(session)
    count = session.scenes.gaussians(session.files.target_scene).count
    source = session.scenes.gaussians(session.files.source_scene).count
    steps = [
        lambda s: moved(session.placed_state()),
        lambda s: replace(s, erased=torch.arange(count) % 7 == 0),
        lambda s: replace(s, corrections=(torch.arange(source) % 3 - 1).to(torch.int8)),
        lambda s: replace(s, light=LIGHT),
        lambda s: replace(s, weights=LayerWeights(shadow=0.5, gloss=0.0, exposure=-0.5)),
        lambda s: replace(s, box=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0), mask_source="grabcut", keep="largest"),
        lambda s: replace(s, harmonizer="reinhard"),
    ]
    for step in steps:
        session.change(step(session.state))
    again = read_state(session.files.file)
    assert again.objects is not None
    assert again.erased is not None
    assert again.corrections is not None
    assert again.light is not None
    assert torch.equal(again.objects[0].target_from_object.translation, torch.tensor([0.1, 0.2, 0.3]))
    assert torch.equal(again.erased, torch.arange(count) % 7 == 0)
    assert torch.equal(again.corrections, (torch.arange(source) % 3 - 1).to(torch.int8))
    assert light_to_json(again.light) == light_to_json(LIGHT)
    assert again.weights == LayerWeights(shadow=0.5, gloss=0.0, exposure=-0.5)
    assert (again.box, again.mask_source, again.keep) == ((0, 0, 0, 1, 1, 1), "grabcut", "largest")
    after = contents(session)
    while session.undo():
        pass
    for name in ("project.toml", "placement.json", "erased.npy"):
        # a table that was made for a key may stay, empty
        assert contents(session).get(name, b"").replace(b"\n[harmonize]\n", b"") == before.get(name, b""), name
    while session.redo():
        pass
    assert contents(session) == after
    # the steps accept the edited project
    read_flow(session.files.file)


def test_the_undo_history_survives_the_session(session: Session) -> None:
    count = session.scenes.gaussians(session.files.target_scene).count
    source = session.scenes.gaussians(session.files.source_scene).count
    states = [contents(session)]
    for step in (
        lambda s: moved(session.placed_state()),
        lambda s: replace(s, erased=torch.arange(count) % 7 == 0),
        lambda s: replace(s, corrections=(torch.arange(source) % 3 - 1).to(torch.int8)),
        lambda s: replace(s, light=LIGHT, box=(0.0, 0.0, 0.0, 1.0, 1.0, 1.5)),
        lambda s: replace(s, weights=LayerWeights(shadow=0.5), light=None, mask_source="grabcut", keep="largest"),
        # unchanged, hence no undo step
        lambda s: replace(s, keep="largest"),
    ):
        session.change(step(session.state))
        states.append(contents(session))
    session.undo()
    again = Session(session.project)
    assert again.notice is None
    assert contents(again) == states[-3]
    assert again.redo()
    assert not again.redo()
    for wanted in reversed(states[1:-2]):
        assert again.undo()
        found, kept = contents(again), ("project.toml", "placement.json", "erased.npy", "corrections.npy")
        for name in kept:
            # a file that project.toml no longer names may stay, and a table that was made for a key, empty
            if name in wanted or name == "placement.json":
                assert found[name].replace(b"\n[relight]\n", b"") == wanted[name].replace(b"\n[relight]\n", b""), name
    # a change while no editor was open is one more step, and states outside the history are deleted
    file = session.files.file
    write_state(file, again.state, replace(again.state, harmonizer="reinhard"))
    third = Session(session.project)
    assert third.state.harmonizer == "reinhard"
    names = {path.stem for path in (session.files.root / ".editor" / "states").iterdir()}
    assert third.undo()
    assert third.state.harmonizer is None
    assert {*third.history.past, *third.history.future, third.history.present} <= names
    # an invalid history is reported, and the session opens without it
    (session.files.root / ".editor" / "history.json").write_text("{")
    fourth = Session(session.project)
    assert fourth.notice is not None
    assert "the undo history is empty now" in fourth.notice
    assert not fourth.undo()


def test_outside_changes_are_loaded_as_an_undo_step(session: Session) -> None:
    assert not session.reload()
    outside = read_state(session.files.file)
    write_state(session.files.file, outside, replace(outside, keep="all"))
    with pytest.raises(ValueError, match="outside"):
        session.change(replace(session.state, keep="largest"))
    assert session.state.keep == "all"
    session.change(replace(session.state, keep="largest"))
    assert read_state(session.files.file).keep == "largest"
    session.undo()
    session.undo()
    assert read_state(session.files.file).keep is None


def test_placement_operations(session: Session) -> None:
    item, up = session.placeable_object(0), torch.tensor([0.0, 0.0, 1.0])
    target = session.scenes.gaussians(session.files.target_scene)
    start = session.objects()[0].target_from_object
    turned = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.7, 0.4], [0.7, 0, 0], [-0.4, 0, 0]]))
    tilted = Similarity(scale=start.scale, rotation=turned @ start.rotation, translation=start.translation + 0.3 * up)
    straight = placement_operations.align_up(item, tilted, up=up)
    # float32 rotations, two deep
    assert torch.allclose(straight.rotation @ item.base.up, up, atol=1e-5)
    assert torch.allclose(straight.points(item.base.point), tilted.points(item.base.point), atol=1e-5)
    fallen = placement_operations.drop_to_surface(target, item, straight, up=up)
    assert fallen.scale == straight.scale
    # the plane's Gaussians are a hundredth thick and were trained for sixty steps
    assert abs(float(fallen.points(item.base.point)[2])) < 0.1
    assert float(fallen.points(item.base.point)[2]) < float(straight.points(item.base.point)[2])
    # the turn about the vertical stayed: heads of a vector at right angles to up agree, but for the slope of the plane
    side = torch.linalg.cross(item.base.up, torch.tensor([1.0, 0, 0]))
    heads = [m.rotation @ side / side.norm() for m in (straight, fallen)]
    assert float(heads[0] @ heads[1]) > 0.98
    again = placement_operations.drop_to_surface(target, item, fallen, up=up)
    assert torch.allclose(again.translation, fallen.translation, atol=0.02)
    half = placement_operations.rescale(item, fallen, 0.5 * fallen.scale)
    assert torch.allclose(half.points(item.base.point), fallen.points(item.base.point), atol=1e-5)


def test_every_kind_of_picture_is_rendered_or_refused_with_a_reason(session: Session) -> None:
    state = session.placed_state()
    camera = session.scenes.cameras(session.files.target_cameras)[0]
    for kind in PICTURE_KINDS:
        if kind == "Result":
            with pytest.raises(ValueError, match="finished run"):
                session.preview.picture(kind, state, camera)
            continue
        picture = session.preview.picture(kind, state, camera)
        assert picture.shape == (camera.height, camera.width, 3)
        assert picture.std() > 1, kind
    assert session.relighting.is_relit(state)
    assert not session.relighting.is_relit(moved(state))
    picture, other = (session.preview.picture(kind, state, camera) for kind in ("Copy-paste", "Mask"))
    both = wipe_comparison(picture, other, 0.25)
    assert (both[:, :10] == picture[:, :10]).all()
    assert (both[:, 20:] == other[:, 20:]).all()


@pytest.mark.parametrize("light", [None, LIGHT])
def test_the_previewed_light_equals_the_step_s_result(session: Session, light: Light | None) -> None:
    session.change(replace(moved(session.placed_state()), weights=LayerWeights(shadow=0.5), light=light))
    # a draft must not change the full result
    draft = session.relighting.scene(session.state, draft=True)
    assert not session.relighting.is_relit(session.state)
    relit = session.relighting.scene(session.state)
    assert session.relighting.scene(session.state, draft=True) is relit
    assert draft.count <= relit.count
    assert main(["run", str(session.files.file), "--to", "relight"]) == 0
    written = read_gaussians(session.files.relit)
    assert torch.equal(written.sh, relit.sh)
    assert torch.equal(written.means, relit.means)


def test_the_light_after_a_move_equals_the_step_s_result(session: Session) -> None:
    relighting, first = session.relighting, session.placed_state()
    relighting.scene(first)
    assert not relighting.can_refine(first)
    session.change(moved(first))
    draft = relighting.scene(session.state, draft=True)
    # drafts keep the sources of the light, which were estimated at another place
    assert relighting.can_refine(session.state)
    relighting.refined(session.state)
    assert relighting.scene(session.state, draft=True) is not draft
    relit = relighting.scene(session.state)
    assert not relighting.can_refine(session.state)
    assert main(["run", str(session.files.file), "--to", "relight"]) == 0
    assert torch.equal(read_gaussians(session.files.relit).sh, relit.sh)


@pytest.mark.parametrize(("seconds", "wanted"), [(0.3, 480), (0.28, 480), (1.2, 240), (0.02, 800), (60.0, 192)])
def test_the_preview_size_adapts_to_the_rendering_time(seconds: float, wanted: int) -> None:
    assert PictureSize().adapted(seconds) == wanted


@pytest.mark.parametrize("light_mode", ["gain", "off"])
def test_the_shown_light_equals_what_the_step_writes(session: Session, light_mode: str) -> None:
    file = session.files.file
    text = with_keys(file.read_text(), "relight", {"light": light_mode})
    file.write_text(text)
    assert session.reload()
    assert main(["run", str(file), "--to", "relight"]) == 0
    state = session.placed_state()
    assert session.relighting.is_relit(state)
    shown, written = session.relighting.scene(state), read_gaussians(session.files.relit)
    assert torch.equal(shown.sh, written.sh)
    assert torch.equal(shown.means, written.means)
    assert light_mode in session.relighting.light_mode_note()
    camera = session.scenes.cameras(session.files.target_cameras)[0]
    with pytest.raises(ValueError, match="physical transfer"):
        session.preview.picture("Shadow layer", state, camera)


def test_a_project_with_trained_scenes_uses_them(session: Session, tmp_path: Path) -> None:
    made = FlowProject(tmp_path / "new" / "project.toml")
    captures = (session.files.source_cameras.parent, session.files.target_cameras.parent)
    with pytest.raises(ValueError, match="trained scene"):
        made.create(captures, scenes=(tmp_path / "none.ply", None))
    made.create(captures, scenes=(session.files.source_scene, None))
    files = made.files()
    assert files is not None
    assert files.without_photos == (False, False)
    assert main(["run", str(made.file), "--to", "source/reconstruct"]) == 0
    assert files.source_scene.read_bytes() == session.files.source_scene.read_bytes()


def test_planned_steps_use_measured_durations(session: Session) -> None:
    flow = read_flow(session.files.file)
    planned = estimate_step_times(flow, ["segment", "relight", "render"])
    assert [step.name for step in planned] == ["segment", "relight", "render"]
    assert [step.is_measured for step in planned] == [True, False, False]
    record = read_record(flow.steps["segment"].out)
    assert record is not None
    assert planned[0].seconds == record.seconds
    # what was not measured keeps its usual share
    assert planned[1].seconds / planned[2].seconds == pytest.approx(15.0 / 6.0)


def test_a_light_is_read_back_as_written() -> None:
    assert light_to_json(light_from_json(light_to_json(LIGHT))) == light_to_json(LIGHT)


def test_the_preview_of_a_photograph_is_unchanged(session: Session, tmp_path: Path) -> None:
    camera = session.scenes.cameras(session.files.target_cameras)[0]
    photo = session.preview.picture("Photograph", session.placed_state(), camera)
    stored = read_rgb(session.files.target_capture.parents[2] / "photos" / "target" / "images" / camera.names[0])
    assert torch.equal(torch.from_numpy(photo), (stored * 255).round().to(torch.uint8))
