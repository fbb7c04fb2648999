"""A light on few Gaussians stands for that on all."""

from dataclasses import replace

import torch

from splatgraft.composition import compose
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity
from splatgraft.editor.previews.draft_preview import carried_over, thinned, thinned_composite
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


def test_a_scene_that_is_small_is_its_own_draft() -> None:
    scene = cloud(50, 0)
    few = thinned(scene, 50)
    assert few.gaussians is scene
    assert few.nearest.tolist() == list(range(50))


def test_each_gaussian_has_the_light_of_the_nearest_that_is_left() -> None:
    target, object_ = cloud(300, 1), cloud(90, 2)
    erased = torch.arange(300) % 5 == 0
    move = Similarity(scale=0.5, rotation=torch.eye(3), translation=torch.tensor([3.0, 0, 0]))
    composite = compose(target, [object_], target_from_objects=[move], erased=erased)
    parts = [thinned(target.select(~erased), 60), thinned(object_, 20)]
    few = thinned_composite(composite, parts[0], parts[1:])
    assert few.merged()[0].count == 80
    # the same tensors for the same parts: what was made of them stays known
    assert thinned_composite(composite, parts[0], parts[1:]).erased is few.erased
    baked, is_object = few.merged()
    plain = unchanged(baked, is_object, objects=(), report=("said",))
    # a light that is a function of the place: its error is what the place of the nearest is off
    lit = carried_over(replace(plain, shadow=0.5 + 0.1 * baked.means), composite, parts)
    whole, flags = composite.merged()
    assert torch.equal(lit.gaussians.means, whole.means)
    assert torch.equal(lit.is_object, flags)
    off = (lit.shadow - (0.5 + 0.1 * whole.means)).norm(dim=1)
    spread = (whole.means[:, None] - baked.means).norm(dim=2).amin(1)
    assert bool((off <= 0.1 * spread + 1e-6).all())  # float32 of numbers up to four
    assert int((spread == 0).sum()) == 80
    assert lit.report == ("said",)
    assert lit.shaded(LayerWeights()).count == whole.count
