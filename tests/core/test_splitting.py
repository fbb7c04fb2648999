"""Wide Gaussians around an object are split: its foot is seen, the scene looks the same, narrow ones are kept."""

from dataclasses import replace

import torch
from shapes import UP, same_bits, surfels

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import concatenate
from splatgraft.core.similarity import Similarity
from splatgraft.core.splitting import split_wide_around
from splatgraft.rendering import render


def flat(points, width, rgb):
    """Return discs that lie on the ground."""
    return replace(
        surfels(points, UP.repeat(len(points), 1), width=width, srgb=rgb, thickness=0.005),
        opacity_logits=2.5 * torch.ones(len(points)),
    )


def table(width, step):
    x = torch.arange(-1.0, 1.001, step)
    points = torch.cartesian_prod(x, x, torch.zeros(1))
    return flat(points, width, (0.8, 0.7, 0.5))


def post():
    """Return an upright post of small balls, 0.3 tall, on the table."""
    z = torch.linspace(0.02, 0.3, 24)
    angle = torch.arange(12) / 12 * 2 * torch.pi
    ring = torch.stack([0.06 * angle.cos(), 0.06 * angle.sin()], 1)
    points = torch.cat([torch.cat([ring, h.expand(12, 1)], 1) for h in z])
    return replace(flat(points, 0.012, (0.1, 0.5, 0.9)), log_scales=torch.full((len(points), 3), -4.4))


CAMERA = pinhole(
    look_at(torch.tensor([[1.6, 0.3, 0.7]]), torch.tensor([0.0, 0.0, 0.1]), UP), 200.0, width=160, height=128
)


def coverage(scene, is_object):
    return render(scene, CAMERA, features=is_object[:, None].float()).features[0, ..., 0]


def test_the_foot_is_seen_the_table_looks_as_it_did_and_objects_are_kept_to_the_bit():
    scene, thing = table(0.15, 0.12), post()
    whole = concatenate([scene, thing])
    is_object = torch.arange(whole.count) >= scene.count
    alone = coverage(thing, torch.ones(thing.count, dtype=torch.bool))
    fine, still = split_wide_around(whole, is_object, [thing])
    there = alone > 0.9
    hidden, shown = (1 - coverage(*pair)[there].mean() for pair in ((whole, is_object), (fine, still)))
    # a disc with its centre nearer than the post covers its foot; of pieces a quarter as wide only a rim remains
    assert hidden > 0.15
    assert shown < 0.5 * hidden
    assert torch.equal(still, torch.arange(fine.count) >= fine.count - thing.count)
    assert same_bits(fine.select(still), thing)
    before, after = (render(g, CAMERA).color[0] for g in (scene, fine.select(~still)))
    # each split may err by 0.05 of alpha at its worst place (see the table in splitting.py), blended with its equals
    assert (before - after).abs().mean() < 0.02
    assert fine.count > whole.count


def test_where_all_is_narrow_or_far_or_no_object_stands_nothing_changes():
    narrow, thing = table(0.02, 0.05), post()
    whole = concatenate([narrow, thing])
    is_object = torch.arange(whole.count) >= narrow.count
    assert split_wide_around(whole, is_object, [thing])[0] is whole
    far = flat(torch.tensor([[30.0, 0, 0]]), 2.0, (0.5, 0.5, 0.5))
    whole = concatenate([far, thing])
    assert split_wide_around(whole, torch.arange(whole.count) >= 1, [thing])[0] is whole
    assert split_wide_around(far, torch.zeros(1, dtype=torch.bool), [])[0] is far


def test_a_baked_composite_is_the_merged_one_with_wide_gaussians_split():
    scene, thing = table(0.15, 0.12), post()
    move = Similarity(scale=1.2, rotation=torch.eye(3), translation=torch.tensor([0.2, 0.1, 0.0]))
    nothing = torch.zeros(scene.count, dtype=torch.bool)
    composite = Composite(scene, (PlacedObject(thing, move),), nothing)
    merged, of_object = composite.merged()
    expected, still = split_wide_around(merged, of_object, [move.gaussians(thing)])
    baked, is_object = composite.bake()
    assert merged.count == scene.count + thing.count < baked.count
    assert torch.equal(is_object, still)
    assert same_bits(baked, expected)
