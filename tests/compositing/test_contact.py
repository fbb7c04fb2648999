"""Contact: a thick floor does not cover the foot of an object on it, and everything else keeps every bit."""

from dataclasses import replace

import pytest
import torch
from shapes import UP, same_bits, surfels

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.compositing.contact import flatten_contact_layers
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians, concatenate, empty
from splatgraft.core.rotations import rotation_about
from splatgraft.core.similarity import Similarity
from splatgraft.rendering import view_operator

RADIUS = 0.3
NOISE = 0.03
"""Standard deviation of the heights of the floor's centres."""
THICKNESS = 0.02
"""Standard deviation of each Gaussian along the normal."""


def ball(height=0.0, center=(0.0, 0.0)) -> Gaussians:
    """Return a ball with its lowest point `height` over the floor."""
    around = even_directions(4000)
    return surfels(RADIUS * around + torch.tensor([*center, RADIUS + height]), around, width=0.01)


def box() -> Gaussians:
    """Return a box's four walls, half width 0.2, height 0.4, on the floor. Like a captured box it has no bottom."""
    along, up = torch.meshgrid(torch.linspace(-0.2, 0.2, 41), torch.linspace(0.005, 0.4, 40), indexing="ij")
    walls = []
    for turn in range(4):
        rotation = rotation_about(UP, turn * torch.pi / 2)
        points = torch.stack([torch.full_like(along, 0.2), along, up], -1).reshape(-1, 3) @ rotation.T
        walls.append(surfels(points, rotation[:, 0].repeat(len(points), 1), width=0.01))
    return concatenate(walls)


def floor(half=2.0, count=160) -> Gaussians:
    """Return a thick, noisy floor in the plane z = 0."""
    x = torch.linspace(-half, half, count)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    z = NOISE * torch.randn(len(grid), 1, generator=torch.Generator().manual_seed(0))
    return surfels(torch.cat([grid, z], 1), UP.repeat(len(grid), 1), width=0.03, thickness=THICKNESS)


def wall() -> Gaussians:
    """Return a wall of the same kind in the plane x = -0.4, 0.1 away from the ball."""
    turn = rotation_about(torch.tensor([0.0, 1.0, 0.0]), torch.pi / 2)
    return Similarity(1.0, turn, torch.tensor([-0.4, 0.0, 0.0])).gaussians(floor())


def shown(thing, target) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the object's share of each pixel from 15 degrees above the floor, in a composite and alone."""
    placed = (PlacedObject(thing, Similarity.identity()),)
    scene, is_object = Composite(target, placed, torch.zeros(target.count, dtype=torch.bool)).bake()
    eye, middle = torch.tensor([[2.9, 0.0, 0.8]]), torch.tensor([0.0, 0.0, 0.1])
    camera = pinhole(look_at(eye, middle, UP), 300.0, width=128, height=96)
    inside = view_operator(scene, camera).blend(is_object.float()[:, None])[..., 0]
    return inside, view_operator(thing, camera).alpha


@pytest.mark.parametrize("thing", [box, ball], ids=["box", "ball"])
def test_the_foot_on_a_thick_floor_is_seen_from_the_side_as_without_a_floor(thing):
    inside, alone = shown(thing(), floor())
    middle = slice(56, 72)
    hidden = (alone - inside).sum(0)[middle]
    # 100 px per unit: three deviations of heights are 0.11, flattened to a fifth 2 px; two widths of the Gaussians
    # in the plane are 0.06, at 15 degrees 1.6 px. Not flattened, the floor hides 9 px of the box.
    assert float(hidden.max()) < 3.6
    # nothing is hidden above that
    assert float((alone - inside)[:56, middle].max()) < 0.01


def test_far_gaussians_keep_every_bit_and_near_ones_their_colour_and_opacity():
    target = floor()
    flattened = flatten_contact_layers(target, [ball()])
    changed = (flattened.means != target.means).any(1)
    away = target.means[:, :2].norm(dim=1)
    assert int(changed.sum()) > 50
    # twice the radius of the bounding sphere and twice the width of the Gaussians
    assert float(away[changed].max()) < 2.2 * (RADIUS + 0.05)
    assert same_bits(flattened.select(~changed), target.select(~changed))
    assert torch.equal(flattened.sh, target.sh)
    assert torch.equal(flattened.opacity_logits, target.opacity_logits)


def test_centres_move_along_the_normal_and_heights_shrink_by_one_factor():
    target = floor()
    flattened = flatten_contact_layers(target, [box()])
    aside = target.means[:, :2].abs().amax(1)
    inside = (aside > 0.15) & (aside < 0.19) & (target.means[:, 2].abs() < 0.06)
    before, after = target.means[inside], flattened.means[inside]
    # the fitted plane is tilted by less than noise / (reach x sqrt(n)) = 0.03 / (0.3 x 30): 0.003 of the 0.1 moved
    torch.testing.assert_close(after[:, :2], before[:, :2], rtol=0, atol=0.001)
    factor = after[:, 2].std() / before[:, 2].std()
    assert float(factor) < 0.25
    widths = flattened.scales[inside].min(1).values
    torch.testing.assert_close(widths, torch.full_like(widths, 0.2 * THICKNESS), rtol=0.05, atol=0)


def test_nothing_changes_below_a_floating_ball_or_without_a_surface_an_object_or_anything_opaque():
    target = floor()
    for height in (0.2, 1.0):
        assert flatten_contact_layers(target, [ball(height)]) is target
    cloud = replace(target, means=torch.rand(target.count, 3, generator=torch.Generator().manual_seed(1)) - 0.5)
    faint = replace(ball(), opacity_logits=torch.full((4000,), -5.0))
    assert flatten_contact_layers(cloud, [ball(-RADIUS)]) is cloud
    assert flatten_contact_layers(target, [empty(), faint]) is target
    assert flatten_contact_layers(target, []) is target
    assert flatten_contact_layers(empty(), [ball()]).count == 0


def test_no_hole_is_dug_for_a_buried_ball():
    target = floor()
    flattened = flatten_contact_layers(target, [ball(-RADIUS)])
    deviation = (NOISE**2 + THICKNESS**2) ** 0.5
    moved = flattened.means[:, 2] - target.means[:, 2]
    # the upper Gaussians come down to one deviation below the middle: from three above at most
    assert float(moved.min()) > -4.1 * deviation
    assert float(flattened.means[:, 2].min()) >= float(target.means[:, 2].min())


def test_a_wall_beside_the_object_is_not_pressed():
    both = concatenate([floor(), wall()])
    higher = (torch.arange(both.count) >= floor().count) & (both.means[:, 2] > 0.2)
    flattened = flatten_contact_layers(both, [ball()])
    assert same_bits(flattened.select(higher), both.select(higher))
    assert not same_bits(flattened, both)


def test_the_vertical_edge_of_a_table_near_the_foot_keeps_every_bit():
    end = 0.3
    top = floor()
    top = top.select(top.means[:, 0] < end)
    y, z = torch.meshgrid(torch.linspace(-2, 2, 160), torch.linspace(-0.3, 0, 13), indexing="ij")
    points = torch.stack([torch.full_like(y, end), y, z], -1).reshape(-1, 3)
    edge = surfels(points, torch.tensor([[1.0, 0.0, 0.0]]).repeat(len(points), 1), width=0.03, thickness=THICKNESS)
    table = concatenate([top, edge])
    flattened = flatten_contact_layers(table, [box()])
    moved = (flattened.means != table.means).any(1)
    assert not bool(moved[top.count :].any())
    under = (top.means[:, :2].abs() < 0.15).all(1)
    assert float(moved[: top.count][under].float().mean()) > 0.9


def test_a_leaf_that_lies_on_the_floor_and_two_objects_are_safe():
    leaf = surfels(ball().means * torch.tensor([1.0, 1.0, 0.001]), UP.repeat(4000, 1), width=0.01)
    far = ball(center=(1.2, 0.0))
    target = floor()
    flattened = flatten_contact_layers(target, [leaf, far])
    assert bool(flattened.means.isfinite().all())
    assert bool(flattened.log_scales.isfinite().all())
    for one in (leaf, far):
        alone = flatten_contact_layers(target, [one])
        changed = (alone.means != target.means).any(1)
        assert bool((flattened.means != target.means).any(1)[changed].all())


def test_a_book_and_a_cup_on_the_table_beside_the_foot_keep_their_shape():
    x, y = torch.meshgrid(torch.linspace(0.35, 0.6, 40), torch.linspace(-0.2, 0.2, 60), indexing="ij")
    top = torch.stack([x, y, torch.full_like(x, 0.09)], -1).reshape(-1, 3)
    both = concatenate([floor(), surfels(top, UP.repeat(len(top), 1), width=0.01)])
    moved = (flatten_contact_layers(both, [ball()]).means - both.means).norm(dim=1)[-len(top) :]
    inner = (top[:, 0] > 0.4) & (top[:, 0] < 0.55) & (top[:, 1].abs() < 0.15)
    # its edge counts in part, because the floor is next to it
    assert float(moved[inner].max()) == 0.0
    turn, up = torch.meshgrid(torch.arange(40) / 40 * 2 * torch.pi, torch.linspace(0, 0.3, 30), indexing="ij")
    outward = torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], -1).reshape(-1, 3)
    wall_ = 0.08 * outward + torch.stack([torch.full_like(up, 0.4), torch.zeros_like(up), up], -1).reshape(-1, 3)
    cup = surfels(wall_, outward, width=0.01)
    flattened = flatten_contact_layers(concatenate([floor(), cup]), [ball()])
    assert same_bits(flattened.select(torch.arange(flattened.count) >= floor().count), cup)


def test_the_result_does_not_depend_on_frame_and_scale():
    target, thing = floor(), box()
    move = Similarity(3.0, rotation_about(torch.tensor([0.6, 0.0, 0.8]), 0.7), torch.tensor([5.0, -2.0, 1.0]))
    expected = move.gaussians(flatten_contact_layers(target, [thing]))
    found = flatten_contact_layers(move.gaussians(target), [move.gaussians(thing)])
    # float32 at coordinates up to 10: 1e-6 each
    torch.testing.assert_close(found.means, expected.means, rtol=0, atol=2e-4)
    torch.testing.assert_close(found.covariances, expected.covariances, rtol=1e-2, atol=1e-5)
