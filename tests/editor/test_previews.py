"""Pictures and previewed light equal the steps' output, bit for bit; drafts are computed on a coarse composite."""

import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import pytest
import torch
from editor_pages import cloud
from test_state import LIGHT, moved
from tiny_project import copy_of

from splatgraft.cli import main
from splatgraft.composition import compose
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import read_rgb
from splatgraft.core.similarity import Similarity
from splatgraft.editor import relit_preview
from splatgraft.editor.pictures import PICTURE_KINDS
from splatgraft.editor.project import Project
from splatgraft.editor.relit_preview import CoarseGaussians, coarsen, upsample_light
from splatgraft.editor.session import Session
from splatgraft.formats import read_gaussians
from splatgraft.project.toml_edit import with_keys
from splatgraft.relighting import LayerWeights, Light
from splatgraft.relighting.layers import pasted


@pytest.fixture(scope="module")
def lit(finished_project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a project from photographs with the physical light transfer, and its results up to the pasted object."""
    folder = copy_of(finished_project, tmp_path_factory.mktemp("lit"))
    file = folder / "project.toml"
    file.write_text(with_keys(file.read_text(), "relight", {"light": "transfer"}))
    for name in ("relit", "views", "harmonized", "result", "report"):
        shutil.rmtree(folder / name)
    return folder


@pytest.fixture
def session(lit: Path, tmp_path: Path) -> Session:
    return Session(Project(copy_of(lit, tmp_path) / "project.toml"))


def test_every_kind_of_picture_is_rendered_or_refused_with_a_reason(session: Session) -> None:
    state = session.placed_state()
    camera = session.scenes.cameras(session.files.target_cameras)[0]
    for kind in PICTURE_KINDS:
        if kind == "Result":
            with pytest.raises(ValueError, match="finished run"):
                session.pictures.view(kind, state, camera)
            continue
        picture = session.pictures.view(kind, state, camera).pixels
        assert picture.shape == (camera.height, camera.width, 3)
        assert picture.std() > 1, kind
    assert session.relighting.is_relit(state)
    assert not session.relighting.is_relit(moved(state))


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
    assert not relighting.refine(first)
    session.change(moved(first))
    draft = relighting.scene(session.state, draft=True)
    # drafts keep the sources of the light, which were estimated at another place
    assert relighting.refine(session.state)
    assert relighting.scene(session.state, draft=True) is not draft
    relit = relighting.scene(session.state)
    assert not relighting.refine(session.state)
    assert main(["run", str(session.files.file), "--to", "relight"]) == 0
    assert torch.equal(read_gaussians(session.files.relit).sh, relit.sh)


def test_the_shown_object_without_light_equals_what_the_step_writes(session: Session) -> None:
    file = session.files.file
    text = with_keys(file.read_text(), "relight", {"light": "off"})
    file.write_text(text)
    assert session.reload()
    assert main(["run", str(file), "--to", "relight"]) == 0
    state = session.placed_state()
    assert session.relighting.is_relit(state)
    shown, written = session.relighting.scene(state), read_gaussians(session.files.relit)
    assert torch.equal(shown.sh, written.sh)
    assert torch.equal(shown.means, written.means)
    assert "off" in session.relighting.light_mode_note()
    camera = session.scenes.cameras(session.files.target_cameras)[0]
    with pytest.raises(ValueError, match="physical transfer"):
        session.pictures.view("Shadow layer", state, camera)


def test_the_preview_of_a_photograph_is_unchanged(session: Session, tmp_path: Path) -> None:
    camera = session.scenes.cameras(session.files.target_cameras)[0]
    photo = session.pictures.view("Photograph", session.placed_state(), camera).pixels
    stored = read_rgb(session.files.root.parent / "photos" / "target" / "images" / camera.names[0])
    assert torch.equal(torch.from_numpy(photo), (stored * 255).round().to(torch.uint8))


def test_a_small_scene_is_not_reduced() -> None:
    scene = cloud(50, 0)
    coarse = coarsen(scene, 50)
    assert coarse.gaussians is scene
    assert coarse.nearest.tolist() == list(range(50))


def test_each_gaussian_gets_the_light_of_the_nearest_coarse_one() -> None:
    target, object_ = cloud(300, 1), cloud(90, 2)
    erased = torch.arange(300) % 5 == 0
    move = Similarity(scale=0.5, rotation=torch.eye(3), translation=torch.tensor([3.0, 0, 0]))
    composite = compose(target, [object_], target_from_objects=[move], erased=erased)
    parts = [coarsen(target.select(~erased), 60), coarsen(object_, 20)]
    coarse = compose(parts[0].gaussians, [parts[1].gaussians], target_from_objects=[move], erased=torch.zeros(60) > 0)
    assert coarse.merged()[0].count == 80
    baked, _ = coarse.merged()
    plain = pasted(coarse, "a sentence")
    # light linear in position: its error is proportional to the distance to the nearest coarse Gaussian
    lit = upsample_light(replace(plain, shadow=0.5 + 0.1 * baked.means), composite, parts)
    whole, flags = composite.merged()
    assert torch.equal(lit.gaussians.means, whole.means)
    assert torch.equal(lit.is_object, flags)
    error = (lit.shadow - (0.5 + 0.1 * whole.means)).norm(dim=1)
    distance = (whole.means[:, None] - baked.means).norm(dim=2).amin(1)
    assert bool((error <= 0.1 * distance + 1e-6).all())  # float32 of numbers up to four
    assert int((distance == 0).sum()) == 80
    assert lit.report == plain.report
    assert lit.shaded(LayerWeights()).count == whole.count


def test_what_drafts_share_is_computed_before_the_first_move(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relit_preview, "TARGET_BUDGET", 60)
    monkeypatch.setattr(relit_preview, "OBJECT_BUDGET", 30)
    reduced: list[int] = []

    def counted(gaussians: Gaussians, budget: int) -> CoarseGaussians:
        reduced.append(gaussians.count)
        return coarsen(gaussians, budget)

    monkeypatch.setattr(relit_preview, "coarsen", counted)
    drawn = MagicMock(side_effect=relit_preview.Composite)
    monkeypatch.setattr(relit_preview, "Composite", drawn)
    drafts = []
    for is_prepared in (False, True):
        session = Session(Project(project))
        state = session.placed_state()
        session.relighting.draft(state)
        # the target and the object; the source follows
        assert len(reduced) == 2
        session.relighting.relit(state)
        if is_prepared:
            session.relighting.prepare_drafts(state)
            assert len(reduced) == 3
        session.set_placement(
            0, replace(session.objects()[0].target_from_object, translation=torch.tensor([0.1, 0, 0]))
        )
        drafts.append(session.relighting.draft(session.placed_state()))
        assert len(reduced) == 3
        # the same tensor in all drafts, so that memos of the light stay valid
        assert len({id(call.kwargs["erased"]) for call in drawn.call_args_list}) == 1
        reduced.clear()
        drawn.reset_mock()
        session.undo()
    assert torch.equal(drafts[0].shadow, drafts[1].shadow)
    assert torch.equal(drafts[0].shade, drafts[1].shade)
