"""Composite: objects are transformed, Gaussians erased and joined; identities hold exactly."""

from dataclasses import fields

import pytest
import torch

from splatgraft.composition import compose
from splatgraft.core.gaussians import Gaussians, empty
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity


def random_gaussians(n, seed, k=16):
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=g),
        log_scales=torch.randn(n, 3, generator=g) * 0.3 - 3,
        quaternions=torch.randn(n, 4, generator=g),
        opacity_logits=torch.randn(n, generator=g),
        sh=torch.randn(n, k, 3, generator=g) * 0.2,
    )


def same_bits(a, b):
    return all(torch.equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(Gaussians))


MOVE = Similarity(
    scale=1.7,
    rotation=rotation_from_quaternion(torch.tensor([[0.3, -0.2, 0.8, 0.1]]))[0],
    translation=torch.tensor([1.0, -2, 0.5]),
)


def test_identity_placement_bakes_the_same_bits():
    target, object_ = random_gaussians(20, 0), random_gaussians(7, 1)
    baked, is_object = compose(target, [object_], target_from_objects=[Similarity.identity()]).merged()
    assert same_bits(baked.select(~is_object), target)
    assert same_bits(baked.select(is_object), object_)


def test_empty_object_is_the_identity_even_with_more_bands():
    target = random_gaussians(20, 0, k=4)
    baked, is_object = compose(target, [empty(sh_degree=3)], target_from_objects=[MOVE]).merged()
    assert same_bits(baked, target)
    assert not is_object.any()


def test_no_objects_and_nothing_erased_is_the_target():
    target = random_gaussians(5, 0)
    baked, _ = compose(target, [], target_from_objects=[]).merged()
    assert same_bits(baked, target)


def test_erased_gaussians_are_gone_and_objects_follow_in_order():
    target, first, second = random_gaussians(20, 0), random_gaussians(3, 1), random_gaussians(4, 2, k=1)
    erased = torch.arange(20) % 3 == 0
    composite = compose(
        target, [first, empty(), second], target_from_objects=[MOVE, MOVE, Similarity.identity()], erased=erased
    )
    baked, is_object = composite.merged()
    index = composite.object_index()
    assert torch.equal(is_object, index >= 0)
    assert same_bits(baked.select(index == -1), target.select(~erased))
    assert same_bits(baked.select(index == 0), MOVE.gaussians(first))
    assert (index == 1).sum() == 0
    assert same_bits(baked.select(index == 2).with_sh_degree(0), second)


def test_wrong_lengths_are_refused():
    target = random_gaussians(5, 0)
    with pytest.raises(ValueError, match="expected one flag for each of 5 Gaussians, found 4"):
        compose(target, [], target_from_objects=[], erased=torch.zeros(4, dtype=torch.bool))
    with pytest.raises(ValueError, match="expected 0 objects"):
        compose(target, [], target_from_objects=[MOVE])
