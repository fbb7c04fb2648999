"""Draft relighting: light computed on a coarse composite, upsampled to all Gaussians."""

from dataclasses import replace

import torch

from splatgraft.composition import compose
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity
from splatgraft.editor.previews.draft_preview import coarse_composite, coarsen, upsample_light
from splatgraft.relighting.layers import LayerWeights, unchanged


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
