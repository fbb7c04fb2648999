"""Composite: objects are transformed, Gaussians erased and joined; identities hold exactly."""

import pytest
import torch
from shapes import random_scene, same_bits

from splatgraft.composition import compose
from splatgraft.core.gaussians import empty
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity

MOVE = Similarity(
    scale=1.7,
    rotation=rotation_from_quaternion(torch.tensor([[0.3, -0.2, 0.8, 0.1]]))[0],
    translation=torch.tensor([1.0, -2, 0.5]),
)


def test_identity_placement_bakes_the_same_bits():
    target, object_ = random_scene(20, 3, 0), random_scene(7, 3, 1)
    baked, is_object = compose(target, [object_], target_from_objects=[Similarity.identity()]).merged()
    assert same_bits(baked.select(~is_object), target)
    assert same_bits(baked.select(is_object), object_)


def test_empty_object_is_the_identity_even_with_more_bands():
    target = random_scene(20, 1, 0)
    baked, is_object = compose(target, [empty(sh_degree=3)], target_from_objects=[MOVE]).merged()
    assert same_bits(baked, target)
    assert not is_object.any()
    assert same_bits(compose(target, [], target_from_objects=[]).merged()[0], target)


def test_erased_gaussians_are_gone_and_objects_follow_in_order():
    target, first, second = random_scene(20, 3, 0), random_scene(3, 3, 1), random_scene(4, 0, 2)
    erased = torch.arange(20) % 3 == 0
    composite = compose(
        target, [first, empty(), second], target_from_objects=[MOVE, MOVE, Similarity.identity()], erased=erased
    )
    baked, is_object = composite.merged()
    kept, index = composite.kept_count, torch.arange(baked.count)
    assert torch.equal(is_object, index >= kept)
    assert same_bits(baked.select(~is_object), target.select(~erased))
    assert same_bits(baked.select((index >= kept) & (index < kept + 3)), MOVE.gaussians(first))
    assert same_bits(baked.select(index >= kept + 3).with_sh_degree(0), second)


def test_wrong_lengths_are_refused():
    target = random_scene(5, 3, 0)
    with pytest.raises(ValueError, match="expected one flag for each of 5 Gaussians, found 4"):
        compose(target, [], target_from_objects=[], erased=torch.zeros(4, dtype=torch.bool))
    with pytest.raises(ValueError, match="expected 0 objects"):
        compose(target, [], target_from_objects=[MOVE])
