"""Draft relighting: light computed on a coarse composite, upsampled to all Gaussians."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_hostile_values import made, project

from splatgraft.commands.edit_project import FlowProject
from splatgraft.composition import compose
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity
from splatgraft.editor.previews import preview_relighting
from splatgraft.editor.previews.draft_preview import CoarseGaussians, coarse_composite, coarsen, upsample_light
from splatgraft.editor.session.session import Session
from splatgraft.relighting.layers import LayerWeights, unchanged

__all__ = ["made", "project"]


def cloud(count: int, seed: int) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.rand(count, 3, generator=generator),
        log_scales=-3 + torch.rand(count, 3, generator=generator),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        opacity_logits=torch.randn(count, generator=generator),
        sh=torch.rand(count, 4, 3, generator=generator),
    )


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
    coarse = coarse_composite(composite, parts[0], parts[1:])
    assert coarse.merged()[0].count == 80
    # the same tensor for the same parts, so that memos stay valid
    assert coarse_composite(composite, parts[0], parts[1:]).erased is coarse.erased
    baked, is_object = coarse.merged()
    plain = unchanged(baked, is_object, objects=(), report=("a sentence",))
    # light linear in position: its error is proportional to the distance to the nearest coarse Gaussian
    lit = upsample_light(replace(plain, shadow=0.5 + 0.1 * baked.means), composite, parts)
    whole, flags = composite.merged()
    assert torch.equal(lit.gaussians.means, whole.means)
    assert torch.equal(lit.is_object, flags)
    error = (lit.shadow - (0.5 + 0.1 * whole.means)).norm(dim=1)
    distance = (whole.means[:, None] - baked.means).norm(dim=2).amin(1)
    assert bool((error <= 0.1 * distance + 1e-6).all())  # float32 of numbers up to four
    assert int((distance == 0).sum()) == 80
    assert lit.report == ("a sentence",)
    assert lit.shaded(LayerWeights()).count == whole.count


def test_what_drafts_share_is_computed_before_the_first_move(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preview_relighting, "TARGET_BUDGET", 60)
    monkeypatch.setattr(preview_relighting, "OBJECT_BUDGET", 30)
    reduced: list[int] = []

    def counted(gaussians: Gaussians, budget: int) -> CoarseGaussians:
        reduced.append(gaussians.count)
        return coarsen(gaussians, budget)

    monkeypatch.setattr(preview_relighting, "coarsen", counted)
    drafts = []
    for is_prepared in (False, True):
        session = Session(FlowProject(project))
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
        reduced.clear()
        session.undo()
    assert torch.equal(drafts[0].shadow, drafts[1].shadow)
    assert torch.equal(drafts[0].shade, drafts[1].shade)
