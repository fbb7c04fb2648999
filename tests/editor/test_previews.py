"""Pictures and previewed light equal the steps' output, bit for bit; drafts are computed on a coarse composite."""

import shutil
from dataclasses import replace
from pathlib import Path
from queue import Queue
from unittest.mock import MagicMock

import pytest
import torch
from editor_pages import cloud
from shapes import UP, ring, sunlit_scene, surfels
from test_state import LIGHT, moved
from tiny_project import copy_of

from splatgraft.cli import main
from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.composition import compose
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity
from splatgraft.editor import relit_preview
from splatgraft.editor.light_process import LightProcess
from splatgraft.editor.pictures import Pictures
from splatgraft.editor.project import Project
from splatgraft.editor.relit_preview import CoarseGaussians, Draft, RelitPreview, coarse_draft, coarsen
from splatgraft.editor.session import Session
from splatgraft.editor.state import EditState
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.project.toml_edit import with_keys
from splatgraft.relighting import LayerWeights, Light, RelightOptions, Relit, SourceScene, transfer
from splatgraft.relighting.layers import pasted
from splatgraft.relighting.transfer import TransferValues


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


@pytest.fixture(scope="module")
def light(lit: Path, tmp_path_factory: pytest.TempPathFactory) -> Relit:
    """Compute the light of that project once; it does not depend on paths."""
    session = Session(Project(copy_of(lit, tmp_path_factory.mktemp("light")) / "project.toml"))
    return RelitPreview(session.scenes).relit(session.placed_state())


def test_every_kind_of_picture_is_rendered_or_refused_with_a_reason(session: Session, light: Relit) -> None:
    state, pictures = session.placed_state(), Pictures(session.scenes)
    camera = session.scenes.cameras("target")[0]
    with pytest.raises(ValueError, match="no result yet"):
        pictures.draw("result", state, camera)
    for kind in ("lit", "pasted", "place"):
        picture = pictures.draw(kind, state, camera)
        assert picture.shape == (camera.height, camera.width, 3)
        assert picture.std() > 1, kind
    pictures.lit.add(state, "final", light)
    assert pictures.lit.stage(state) == "final"
    # a draft that comes late does not replace it
    pictures.lit.add(state, "draft", light)
    assert pictures.lit.stage(state) == "final"
    assert pictures.lit.stage(moved(state)) == ""


def test_a_moved_object_keeps_its_colours_over_a_contact_shadow_until_its_light_is_there(
    session: Session, light: Relit
) -> None:
    lit, state = Pictures(session.scenes).lit, session.placed_state()
    lit.add(state, "final", light)
    before, is_object = light.bake(state.weights)
    assert lit.scene(state) is lit.scene(state)
    assert torch.equal(lit.scene(state).sh, before.sh)
    placed = session.objects()[0].target_from_object
    shift = torch.tensor([0.3, 0.0, 0.0])
    there = replace(placed, translation=placed.translation + shift)
    after = lit.scene(state.with_object(0, replace(session.objects()[0], target_from_object=there)))
    count = int(is_object.sum())
    # float32 of two transforms
    assert torch.allclose(after.means[-count:], before.means[is_object] + shift, atol=1e-5)
    assert torch.allclose(after.sh[-count:, 0], before.sh[is_object][:, 0], atol=1e-5)
    place = lit.place(state)
    darker = (place.sh[:, 0] - after.sh[: place.count, 0]).mean(1)
    foot = there.points(session.placeable_object(0).base.point)
    apart = (place.means - foot)[:, :2].norm(dim=1)
    assert float(darker[apart < 0.15].max()) > 0.1
    assert bool((darker >= -1e-6).all())
    assert float(darker[apart > 1.0].abs().max()) < 0.02
    # the place itself is as it was
    assert torch.equal(lit.place(state).sh, session.scenes.scene("target").sh)


def test_a_dragged_object_stands_on_its_flattened_support_wherever_it_was_before(session: Session) -> None:
    x = torch.linspace(-1.5, 1.5, 120)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    heights = 0.03 * torch.randn(len(grid), 1, generator=torch.Generator().manual_seed(0))  # a layer, not a sheet
    floor = surfels(torch.cat([grid, heights], 1), UP.repeat(len(grid), 1), width=0.03, thickness=0.02)
    write_gaussians(session.files.scenes["target"], floor)
    lit, state = Pictures(session.scenes).lit, session.placed_state()
    item, place = session.objects()[0], lit.place(state)
    placed = item.target_from_object
    for shift in ([0.5, 0.2, 0.0], [-0.4, 0.3, 0.0], [0.1, -0.3, 0.5]):
        there = replace(placed, translation=placed.translation + torch.tensor(shift))
        dragged = state.with_object(0, replace(item, target_from_object=there))
        scene = lit.scene(dragged)
        expected = session.scenes.composite(dragged).merged()[0]
        # the step's composite; the colours have the contact shadow of this place alone
        assert torch.equal(scene.means, expected.means)
        assert torch.equal(scene.log_scales, expected.log_scales)
        assert torch.equal(scene.sh, Pictures(session.scenes).lit.scene(dragged).sh)
        is_flat = not torch.equal(scene.means[: place.count], place.means)
        assert is_flat == (shift[2] == 0)  # nothing is flattened under an object in the air


def test_a_finished_light_is_read_from_its_file(session: Session) -> None:
    assert main(["run", str(session.files.file), "--to", "relight"]) == 0
    lit, state = Pictures(session.scenes).lit, session.placed_state()
    lit.adopt(state)
    assert lit.stage(state) == "file"
    assert torch.equal(lit.scene(state).sh, read_gaussians(session.files.relit).sh)
    # its layers are not known: other weights need them
    assert lit.stage(replace(state, weights=LayerWeights(shadow=0.5))) == "draft"


@pytest.mark.parametrize("light", [None, pytest.param(LIGHT, marks=pytest.mark.long)])
def test_the_previewed_light_equals_the_step_s_result(session: Session, light: Light | None) -> None:
    session.change(replace(moved(session.placed_state()), weights=LayerWeights(shadow=0.5), light=light))
    relighting = RelitPreview(session.scenes)
    # a draft must not change the full result
    draft = relighting.draft(session.state).of_all(session.scenes.composite(session.state))
    assert not relighting.is_relit(session.state)
    relit = relighting.relit(session.state)
    assert relighting.is_relit(session.state)
    assert draft.gaussians.count <= relit.gaussians.count
    assert main(["run", str(session.files.file), "--to", "relight"]) == 0
    written, shown = read_gaussians(session.files.relit), relit.bake(session.state.weights)[0]
    assert torch.equal(written.sh, shown.sh)
    assert torch.equal(written.means, shown.means)


def test_the_light_after_a_move_equals_the_step_s_result(session: Session) -> None:
    relighting, first = RelitPreview(session.scenes), session.placed_state()
    relighting.relit(first)
    session.change(moved(first))
    relighting.draft(session.state)
    # drafts keep the sources of the light, which were estimated at another place
    relit = relighting.relit(session.state)
    assert main(["run", str(session.files.file), "--to", "relight"]) == 0
    assert torch.equal(read_gaussians(session.files.relit).sh, relit.bake(session.state.weights)[0].sh)


def test_the_shown_object_without_light_equals_what_the_step_writes(session: Session) -> None:
    file = session.files.file
    file.write_text(with_keys(file.read_text(), "relight", {"light": "off"}))
    assert session.reload()
    assert main(["run", str(file), "--to", "relight"]) == 0
    state, pictures = session.placed_state(), Pictures(session.scenes)
    shown, written = pictures.lit.scene(state), read_gaussians(session.files.relit)
    assert torch.equal(shown.sh, written.sh)
    assert torch.equal(shown.means, written.means)
    assert pictures.lit.relit(state) is None


@pytest.mark.long
def test_the_light_process_makes_drafts_of_what_is_asked_last(session: Session) -> None:
    answers: Queue[tuple[EditState, str, Relit | Draft]] = Queue()
    errors = MagicMock()
    process = LightProcess(Project(session.files.file), lambda *answer: answers.put(answer), errors)
    try:
        state = session.placed_state()
        process.want(state, "prepared")
        places = [moved(state) for _ in range(4)]
        for place in places:
            process.want(place, "draft")
        received = [answers.get(timeout=120)]
        while received[-1][0] is not places[-1]:
            received.append(answers.get(timeout=120))
        assert len(received) < len(places)  # places that were left while a draft was made have none
        assert not any(shown is state for shown, *_ in received)  # what is only prepared is not sent
        shown, stage, layers = received[-1]
        assert stage == "draft"
        assert isinstance(layers, Draft)
        assert layers.relit.gaussians.count == 0
        expected = RelitPreview(session.scenes).draft(shown).of_all(session.scenes.composite(shown))
        scenes = Pictures(session.scenes).lit
        scenes.add(shown, "draft", layers)
        drawn = scenes.scene(shown)
        assert torch.equal(drawn.means, expected.bake(shown.weights)[0].means)
        process.want(shown, "final")
        stages = [answers.get(timeout=120)[1] for _ in range(2)]
        assert stages[-1] == "final"
    finally:
        process.close()
    errors.assert_not_called()


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
    lit = coarse_draft(replace(plain, shadow=0.5 + 0.1 * baked.means), parts).of_all(composite)
    whole, flags = composite.merged()
    assert torch.equal(lit.gaussians.means, whole.means)
    assert torch.equal(lit.is_object, flags)
    error = (lit.shadow - (0.5 + 0.1 * whole.means)).norm(dim=1)
    distance = (whole.means[:, None] - baked.means).norm(dim=2).amin(1)
    assert bool((error <= 0.1 * distance + 1e-6).all())  # float32 of numbers up to four
    assert int((distance == 0).sum()) == 80
    assert lit.report == plain.report
    assert lit.shaded(LayerWeights()).count == whole.count


@pytest.mark.long
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
        state, relighting = session.placed_state(), RelitPreview(session.scenes)
        relighting.draft(state)
        # the target and the object
        assert len(reduced) == 2
        relighting.relit(state)
        if is_prepared:
            relighting.prepare_drafts(state)
        session.set_placement(
            0, replace(session.objects()[0].target_from_object, translation=torch.tensor([0.1, 0, 0]))
        )
        drafts.append(relighting.draft(session.placed_state()))
        assert len(reduced) == 2
        # the same tensor in all drafts, so that memos of the light stay valid
        assert len({id(call.kwargs["erased"]) for call in drawn.call_args_list}) == 1
        reduced.clear()
        drawn.reset_mock()
        session.step(-1)
    assert torch.equal(drafts[0].relit.shadow, drafts[1].relit.shadow)
    assert torch.equal(drafts[0].relit.shade, drafts[1].relit.shade)


@pytest.mark.long
def test_a_draft_takes_the_light_at_the_old_place_from_the_full_transfer(monkeypatch: pytest.MonkeyPatch) -> None:
    estimated = MagicMock(side_effect=transfer.find_source_light)
    monkeypatch.setattr(transfer, "find_source_light", estimated)
    floor = sunlit_scene(torch.tensor([0.6, 0.0, 0.8]), 3.0)
    around = even_directions(200)
    ball = surfels(0.2 * around + torch.tensor([0.0, 0.0, 0.2]), around, width=0.03)
    cameras = ring(6)
    transfers = [TransferValues(lambda: None) for _ in range(2)]
    fewer = floor.select(torch.arange(0, floor.count, 2)), ball.select(torch.arange(100))
    pairs = [(part, SourceScene(scene, cameras)) for scene, part in ((floor, ball), fewer)]
    transfers[1].share_source_light(pairs[1], transfers[0], pairs[0])  # nothing is there yet
    for (part, source), values in zip(pairs, transfers, strict=True):
        composite = Composite(
            floor, (PlacedObject(part, Similarity.identity()),), torch.zeros(floor.count, dtype=torch.bool)
        )
        values.relight(
            composite, cameras, sources=[source], light=LIGHT, options=RelightOptions(fitted_views=0), exact=False
        )
        transfers[1].share_source_light(pairs[1], transfers[0], pairs[0])
    assert estimated.call_count == 1
