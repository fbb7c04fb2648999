"""Automatic placement in a synthetic room: a table under a ceiling, a box to place on it, floaters in the air."""

import math
from dataclasses import replace

import pytest
import torch
from shapes import UP, blobs, ring

from splatgraft.cli import main
from splatgraft.composition import (
    Coverage,
    NoFreePlaceError,
    PlaceOptions,
    compose,
    hidden_fraction,
    object_base,
    place_object,
    rest_on_surface,
    support_below,
)
from splatgraft.composition.placement import facing_yaw_deg
from splatgraft.composition.places import scale_in_view
from splatgraft.composition.support_surface import height_map
from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.capture_orientation import estimate_up, focus_point
from splatgraft.core.gaussians import Gaussians, concatenate, empty
from splatgraft.core.images import read_rgb
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.rotations import quaternion_from_rotation, rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.formats import write_capture, write_gaussians

TABLE = 0.7


def sheet(center, u, v, *, spacing=0.06, noise=0.004, seed=0):
    """Return flat Gaussians on the parallelogram center +- u +- v."""
    g = torch.Generator().manual_seed(seed)
    center, u, v = (torch.tensor(x, dtype=torch.float32) for x in (center, u, v))
    nu, nv = (max(2, math.ceil(2 * float(x.norm()) / spacing)) for x in (u, v))
    a, b = torch.meshgrid(torch.linspace(-1, 1, nu), torch.linspace(-1, 1, nv), indexing="ij")
    normal = torch.nn.functional.normalize(torch.linalg.cross(u, v), dim=0)
    means = center + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v
    means = means + noise * torch.randn(len(means), 1, generator=g) * normal
    axes = torch.stack([u / u.norm(), torch.linalg.cross(normal, u / u.norm()), normal], -1)
    n = len(means)
    return Gaussians(
        means=means,
        log_scales=torch.tensor([spacing * 0.7, spacing * 0.7, 0.003]).log().repeat(n, 1),
        quaternions=quaternion_from_rotation(axes[None]).repeat(n, 1),
        opacity_logits=torch.full((n,), 4.0),
        sh=torch.zeros(n, 1, 3),
    )


def box(center, half, spacing=0.03):
    center, half = torch.tensor(center), torch.diag(torch.tensor(half))
    sides = [(axis, sign) for axis in (2, 0, 1) for sign in (1, -1)]
    return concatenate(
        [
            sheet(
                (center + sign * half[axis]).tolist(),
                *(half[i].tolist() for i in range(3) if i != axis),
                spacing=spacing,
                seed=seed,
            )
            for seed, (axis, sign) in enumerate(sides, 1)
        ]
    )


def room(ceiling=True, floaters=40):
    g = torch.Generator().manual_seed(9)
    parts = [
        sheet((0, 0, 0), (2, 0, 0), (0, 2, 0)),
        sheet((0, 0, TABLE), (0.6, 0, 0), (0, 0.4, 0), spacing=0.03),
        sheet((2, 0, 1.2), (0, 2, 0), (0, 0, 1.2)),
    ]
    if ceiling:
        parts.append(sheet((0, 0, 2.4), (2, 0, 0), (0, 2, 0)))
    n = floaters
    points = (torch.rand(n, 3, generator=g) - 0.5) * torch.tensor([2.0, 2, 0.8]) + torch.tensor([0, 0, 1.2])
    return concatenate([*parts, blobs(points, 0.03, opacity_logit=-1.5)])


def ring_of_cameras(center=(0.0, 0, TABLE), count=16, height=0.7, distance=1.6):
    angle = torch.arange(count) / count * 2 * math.pi
    g = torch.Generator().manual_seed(2)
    eyes = torch.stack([angle.cos() * distance, angle.sin() * distance, torch.rand(count, generator=g) * 0.3], -1)
    eyes = eyes + torch.tensor(center) + torch.tensor([0, 0, height])
    return pinhole(look_at(eyes, torch.tensor(center), UP), 150.0, width=160, height=120)


def outward(cameras: Cameras) -> Cameras:
    """Return the same cameras, rolled."""
    poses = cameras.world_from_camera.clone()
    poses[:, :3, [0, 2]] *= -1
    return replace(cameras, world_from_camera=poses)


THING = box((0, 0, 0.15), (0.1, 0.1, 0.15))
OWN = ring_of_cameras((0.0, 0, 0.15), height=0.5)
"""Object and the cameras of its capture."""


TURN = Similarity(
    scale=3.0,
    rotation=rotation_from_quaternion(torch.tensor([[0.6, -0.4, 0.5, 0.3]]))[0],
    translation=torch.tensor([4.0, -1, 2]),
)


@pytest.mark.parametrize("move", [Similarity.identity(), TURN])
def test_up_and_focus_are_found_in_any_frame(move):
    cameras = move.cameras(ring_of_cameras())
    # the prior weighs 0.01 beside a spread of 0.5: 2% of the half degree by which the images' mean up is tilted
    assert torch.allclose(estimate_up(cameras), move.rotation @ UP, atol=5e-4)
    assert torch.allclose(focus_point(cameras), move.points(torch.tensor([0.0, 0, TABLE])), atol=1e-3)


def test_a_few_rolled_photos_do_not_turn_up():
    cameras = ring_of_cameras()
    poses = cameras.world_from_camera.clone()
    roll = rotation_from_quaternion(torch.tensor([[1.0, 0, 0, 1]]))[0]
    poses[:3, :3, :3] = poses[:3, :3, :3] @ roll
    rolled = pinhole(poses, 150.0, width=160, height=120)
    # 3 of 16 photos are upright by 90 degrees of roll; within 2 degrees
    assert float(estimate_up(rolled) @ UP) > math.cos(math.radians(2))


@pytest.mark.parametrize("start", [TABLE + 0.3, TABLE + 1.0, TABLE, TABLE + 0.01])
def test_support_is_the_table_under_a_ceiling_and_through_floaters(start):
    found = support_below(room(), torch.tensor([0.1, -0.05, start]), up=UP, radius=0.15)
    # surface noise is 4 mm, floaters have an opacity of 0.18: a centimetre
    assert abs(float(found.point[2]) - TABLE) < 0.01
    assert torch.allclose(found.point[:2], torch.tensor([0.1, -0.05]), atol=1e-5)
    assert float(found.normal @ UP) > math.cos(math.radians(3))
    assert found.flat_fraction > 0.8
    assert found.obstructed_fraction < 0.1


def glossy_room():
    """Return a table top that lets light through, with its reflections deep below it, like a fit of photos."""
    table = sheet((0, 0, TABLE), (0.6, 0, 0), (0, 0.4, 0), spacing=0.03)
    table = replace(table, opacity_logits=torch.full((table.count,), -0.4))
    below = sheet((0, 0, TABLE - 0.4), (0.6, 0, 0), (0, 0.4, 0), spacing=0.05, noise=0.1, seed=3)
    return concatenate([sheet((0, 0, 0), (2, 0, 0), (0, 2, 0)), table, below])


def test_a_glossy_table_is_level_and_its_edges_stay():
    scene = glossy_room()
    ground = height_map(scene, torch.tensor([0.0, 0, TABLE + 0.1]), up=UP, radius=1.0, top=0.5)
    x, y = ground.points[..., 0].abs(), ground.points[..., 1].abs()
    heights = ground.points[..., 2]
    within = heights[(x < 0.5) & (y < 0.3)]
    assert float((within - TABLE).abs().quantile(0.98)) < 0.02
    assert float(heights[(x > 0.7) | (y > 0.5)].max()) < 0.1
    placed = place_object(scene, box((0, 0, 0), (0.1, 0.1, 0.1)), cameras=(ring_of_cameras(), ring_of_cameras()))
    assert float(placed.support.point[2]) == pytest.approx(TABLE, abs=0.02)
    assert placed.support.flat_fraction > 0.9


def test_a_floor_below_haze_is_where_it_is():
    floor, haze = (sheet((0, 0, z), (2, 0, 0), (0, 2, 0), spacing=0.05) for z in (0.0, 0.03))
    haze = replace(haze, opacity_logits=torch.full((haze.count,), -2.5))
    ground = height_map(concatenate([floor, haze]), torch.zeros(3), up=UP, radius=0.5, top=0.3, size=64)
    heights = ground.heights[ground.alpha > 0.5]
    assert float(heights.min()) > -0.01
    assert float(heights.max()) < 0.03


def test_a_cloth_with_folds_is_level_ground():
    cloth = sheet((0, 0, TABLE), (0.6, 0, 0), (0, 0.4, 0), spacing=0.01)
    folds = 0.01 * torch.sin(60 * cloth.means[:, 0])
    cloth = replace(cloth, means=cloth.means + folds[:, None] * UP)
    found = support_below(cloth, torch.tensor([0.0, 0, TABLE + 0.05]), up=UP, radius=0.1)
    assert found.flat_fraction > 0.8
    assert found.obstructed_fraction < 0.05


def test_the_slope_of_a_cloth_s_edge_does_not_tilt_and_a_slope_all_around_does():
    cloth = sheet((0, 0, TABLE), (0.42, 0, 0), (0, 0.4, 0), spacing=0.01, noise=0.001)
    # its edge hangs by 15 degrees
    drop = math.tan(math.radians(15)) * (cloth.means[:, 0] - 0.3).clamp_min(0)
    hanging = replace(cloth, means=cloth.means - drop[:, None] * UP)
    found = support_below(hanging, torch.tensor([0.36, 0, TABLE]), up=UP, radius=0.05)
    assert math.degrees(math.acos(min(1.0, float(found.normal @ UP)))) < 2
    assert float(found.point[2]) == pytest.approx(TABLE - 0.06 * math.tan(math.radians(15)), abs=0.01)
    assert found.flat_fraction < 0.9  # a level place comes before it
    slope = replace(cloth, means=cloth.means - 0.2 * cloth.means[:, :1] * UP)
    found = support_below(slope, torch.tensor([0.1, 0, TABLE]), up=UP, radius=0.05)
    assert float(found.normal[0] / found.normal[2]) == pytest.approx(0.2, abs=0.02)


def test_support_beside_the_table_is_the_floor_and_nothing_below_is_said():
    found = support_below(room(), torch.tensor([-1.2, 1.0, 1.0]), up=UP, radius=0.15)
    assert abs(float(found.point[2])) < 0.01
    with pytest.raises(ValueError, match="expected a surface below"):
        support_below(room(), torch.tensor([0.0, 0, -0.5]), up=UP, radius=0.15)


def test_a_wall_is_a_poor_support_and_a_hole_below_a_point_takes_the_level_around_it():
    wall = sheet((0, 0, 0), (0.4, 0, 0.9), (0, 1, 0), spacing=0.04)
    found = support_below(wall, torch.tensor([0.0, 0, 0.5]), up=UP, radius=0.2)
    # a slope of 66 degrees rises by 0.9 in a disc of 0.4: the part within 6% of the radius of one level is 2%
    assert found.flat_fraction < 0.15
    table = sheet((0, 0, TABLE), (0.6, 0, 0), (0, 0.4, 0), spacing=0.03)
    holed = table.select(table.means[:, :2].norm(dim=1) > 0.15)
    found = support_below(holed, torch.tensor([0.0, 0, TABLE + 0.2]), up=UP, radius=0.1)
    assert abs(float(found.point[2]) - TABLE) < 0.01


def rubble():
    """Return boxes of different heights all over the floor, all smaller than the object."""
    g = torch.Generator().manual_seed(5)
    places = torch.cartesian_prod(torch.linspace(-0.8, 0.8, 9), torch.linspace(-0.8, 0.8, 9))
    heights = 0.1 + 0.5 * torch.rand(len(places), generator=g)
    return concatenate(
        [
            sheet((float(x), float(y), float(z)), (0.08, 0, 0.05), (0, 0.08, 0.03), spacing=0.03)
            for (x, y), z in zip(places, heights, strict=True)
        ]
    )


def test_where_nothing_is_level_the_nearest_to_it_is_taken_with_the_reason():
    cameras = (ring_of_cameras((0.0, 0, 0.3), height=0.9), OWN)
    placed = place_object(rubble(), THING, cameras=cameras, options=PlaceOptions(scale=3.0))
    assert placed.support.point[:2].abs().max() < 1.0
    assert any("level" in warning.text for warning in placed.warnings)
    named = PlaceOptions(scale=3.0, point=(0.1, 0.1, 0.5))
    placed = place_object(rubble(), THING, cameras=cameras, options=named)
    assert any("level" in warning.text for warning in placed.warnings)


def test_cameras_that_look_outwards_give_a_place_between_them_with_the_reason():
    cameras = outward(ring_of_cameras(distance=0.4))
    with pytest.raises(ValueError, match="name the place"):
        focus_point(cameras)
    placed = place_object(room(), THING, cameras=(cameras, OWN), options=PlaceOptions(scale=0.5))
    assert any("do not look at one place" in warning.text for warning in placed.warnings)
    # on the table or the floor
    assert min(abs(float(placed.support.point[2]) - z) for z in (0.0, TABLE)) < 0.02


def test_nothing_at_all_is_said():
    far = sheet((50, 0, 0), (1, 0, 0), (0, 1, 0))
    with pytest.raises(ValueError, match="expected a surface where the cameras look, found none; name a point"):
        place_object(far, THING, cameras=(ring_of_cameras(), OWN))


def test_base_comes_from_the_surface_where_the_source_has_one():
    table = sheet((0, 0, 0), (1, 0, 0), (0, 1, 0))
    # a hole under the box, and 3 cm of the table's top left on the box by its mask
    hole = (table.means[:, :2].abs().amax(-1)) > 0.1
    thing = concatenate([THING, sheet((0, 0, -0.02), (0.1, 0, 0), (0, 0.1, 0))])
    own = object_base(thing, up=UP)
    assert own.stands_on == "extent"
    found = object_base(thing, up=UP, surroundings=table.select(hole))
    assert found.stands_on == "surface"
    assert abs(float(found.point[2])) < 0.01
    # height 0.3; up to a sheet's spread of 2 cm at the rim
    assert abs(found.height - 0.3) < 0.03
    # half diagonal 0.141; the 97th percentile of a square's perimeter lies a little within
    assert 0.1 < found.radius < 0.17


def test_a_ledge_above_the_foot_of_what_hangs_is_not_its_ground():
    ledge = sheet((0, 0.22, 0.06), (0.3, 0, 0), (0, 0.11, 0))
    base = object_base(THING, up=UP, surroundings=ledge)
    assert base.stands_on == "extent"
    # the lowest Gaussians reach 2 cm below their centres
    assert abs(float(base.point[2])) < 0.03
    with pytest.raises(ValueError, match="found an empty one"):
        object_base(empty(), up=UP)


@pytest.mark.parametrize("move", [Similarity.identity(), TURN])
def test_the_box_rests_upright_with_its_foot_on_the_table_in_any_source_frame(move):
    thing = box((0, 0, 0.15), (0.1, 0.08, 0.15))
    cameras, turned = move.cameras(OWN), move.gaussians(thing)
    base = object_base(turned, up=estimate_up(cameras))
    where = torch.tensor([0.2, 0.1, TABLE + 0.2])
    found, _ = rest_on_surface(room(), base, point=where, up=UP, scale=1 / move.scale)
    placed = found.gaussians(turned)
    low, high = placed.means[:, 2].quantile(0.02), placed.means[:, 2].quantile(0.98)
    # percentiles include each Gaussian's own extent of about 2 cm on the sides
    assert abs(float(low) - TABLE) < 0.03
    assert abs(float(high - low) - 0.3) < 0.02
    middle = (placed.means[:, :2].amin(0) + placed.means[:, :2].amax(0)) / 2
    assert torch.allclose(middle, where[:2], atol=0.02)


def test_yaw_turns_and_offset_shifts():
    base = object_base(box((0, 0, 0.15), (0.1, 0.04, 0.15)), up=UP)
    where, flat = torch.tensor([0.0, 0, 1.0]), room(floaters=0)
    plain, _ = rest_on_surface(flat, base, point=where, up=UP)
    turned, _ = rest_on_surface(flat, base, point=where, up=UP, yaw_deg=90.0)
    x = torch.tensor([1.0, 0, 0])
    # the normal is measured, to a fraction of a degree
    assert torch.allclose(turned.rotation @ x, plain.rotation @ torch.tensor([0.0, 1, 0]), atol=0.02)
    options = PlaceOptions(point=(0.0, 0.0, 1.0), scale=1.0, yaw_deg=0.0)
    placed, shifted = (
        place_object(flat, THING, cameras=(ring_of_cameras(), OWN), options=replace(options, offset=offset))
        for offset in ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0))
    )
    moved = shifted.target_from_object.translation - placed.target_from_object.translation
    assert torch.allclose(moved, torch.tensor([0.1, 0, 0]), atol=1e-5)


def test_an_automatic_place_is_on_the_table_in_sight_and_free():
    placed = place_object(room(), THING, cameras=(ring_of_cameras(), OWN))
    assert abs(float(placed.support.point[2]) - TABLE) < 0.015
    assert placed.support.point[:2].abs().max() < 0.5
    assert placed.hidden_fraction < 1 / 6  # share of the underside
    assert placed.warnings == ()
    # three tenths of 120 px: at 1.6-1.8 m and a focal length of 150 px that is 0.4 m, for 0.3 m of height
    assert 0.8 < placed.target_from_object.scale < 1.8


def test_a_second_object_finds_another_place():
    cameras, options = (ring_of_cameras(), OWN), PlaceOptions(scale=1.0)
    first = place_object(room(), THING, cameras=cameras, options=options)
    both, _ = compose(room(), [THING], target_from_objects=[first.target_from_object]).merged()
    second = place_object(both, THING, cameras=cameras, options=options)
    assert abs(float(second.support.point[2]) - TABLE) < 0.02
    apart = (first.support.point - second.support.point).norm()
    assert apart > 0.18  # two boxes 0.2 wide


def test_an_object_in_the_wall_is_reported():
    thing, cameras = box((0, 0, 0), (0.1, 0.1, 0.1)), ring_of_cameras()
    inside_floor = Similarity(scale=1.0, rotation=torch.eye(3), translation=torch.tensor([0.0, -0.7, -0.3]))
    on_table = Similarity(scale=1.0, rotation=torch.eye(3), translation=torch.tensor([0.0, 0, TABLE + 0.1]))
    assert hidden_fraction(room(), inside_floor.gaussians(thing), cameras=cameras) > 0.9
    # the box's own underside is a sixth of its surface
    assert hidden_fraction(room(), on_table.gaussians(thing), cameras=cameras) < 1 / 6
    assert hidden_fraction(room(), empty(), cameras=cameras) == 0
    placed = place_object(
        room(),
        thing,
        cameras=(cameras, cameras),
        options=PlaceOptions(point=(0.0, 0.0, TABLE + 0.3), offset=(0.0, -0.9, -1.2), scale=1.0),
    )
    assert any("hidden from every camera" in warning.text for warning in placed.warnings)


def directions(*degrees):
    angle = torch.deg2rad(torch.tensor(degrees))
    return torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, 0.5)], -1)


def test_the_photographed_side_is_turned_to_the_cameras():
    arc, other = directions(0.0, 20.0, 40.0), directions(100.0, 120.0, 140.0)
    assert facing_yaw_deg(arc, other, up=UP) == pytest.approx(100, abs=10)  # flat optimum, 5 degree steps
    assert facing_yaw_deg(arc, other, up=-UP) == pytest.approx(-100, abs=10)
    assert facing_yaw_deg(arc, arc, up=UP) == 0
    around = directions(*[15.0 * i for i in range(24)])
    assert facing_yaw_deg(around, other, up=UP) == 0


def test_sides_that_no_photo_shows_are_measured_and_said():
    front, around = directions(-40.0, 0.0, 40.0), directions(*[15.0 * i for i in range(24)])
    assert Coverage.of(front, front, UP).unseen_share == 0
    assert Coverage.of(around, front, UP).unseen_share == 0
    # 180 degrees are photographed: 80 between the outermost photos and 50 beyond each; 26.6 degrees of height less
    half = Coverage.of(front, around, UP)
    assert half.unseen_share == pytest.approx(0.45, abs=0.1)
    # the picture from above, y up: green towards the photographs, red on the other side
    x, y = torch.nn.functional.normalize(half.photographs.mean(0)[:2], dim=0).tolist()
    picture = half.draw()
    there, behind = (picture[round(160 - side * 110 * y), round(160 + side * 110 * x)] for side in (1, -1))
    assert there[1] > there[0]
    assert behind[0] > behind[1]
    thing = box((0.0, 0.0, 0.1), (0.05, 0.05, 0.1))
    target = orbit(0.0, 2 * math.pi, count=12)
    half = orbit(0.0, 0.6, count=6)
    assert place_object(room(), thing, cameras=(target, half)).coverage.unseen_share > 0.2
    assert place_object(room(), thing, cameras=(target, target)).coverage.unseen_share == 0


def orbit(first, last, *, count):
    angle = torch.linspace(first, last, count + 1)[:-1]
    eyes = torch.stack([1.6 * angle.cos(), 1.6 * angle.sin(), torch.full_like(angle, TABLE + 0.8)], 1)
    return pinhole(look_at(eyes, torch.tensor([0.0, 0.0, TABLE]), UP), 200.0, width=240, height=180)


def cameras_that_look_at_the_edge():
    return ring(12, height=0.8, radius=1.6, center=(0.55, 0.0, TABLE), focal=200.0, size=(240, 180))


def test_a_place_is_away_from_the_table_s_edge_and_a_warning_says_where_none_is():
    cameras = cameras_that_look_at_the_edge()

    def placed(half):
        thing = box((0.0, 0.0, half), (half, half, half), spacing=0.015)
        table = sheet((0, 0, TABLE), (0.6, 0, 0), (0, 0.4, 0), spacing=0.03)
        return place_object(table, thing, cameras=(cameras, cameras), options=PlaceOptions(scale=1.0))

    found = placed(0.07)
    # most of the triple radius of .07 to .1 is kept, which would be .3 from the edge at .6
    assert found.support.point[0] < 0.4
    assert found.support.point[1].abs() < 0.2
    assert not any("edge" in note.text for note in found.warnings)
    assert any("near the edge" in note.text for note in placed(0.2).warnings)


def test_a_size_that_is_guessed_does_not_fill_a_small_table():
    small = sheet((0, 0, TABLE), (0.3, 0, 0), (0, 0.3, 0), spacing=0.03)
    placed = place_object(small, THING, cameras=(ring_of_cameras(), OWN))
    # its rim keeps its own width from the edge if possible: at 3 radii from the middle about .7 of the disc is table
    assert placed.target_from_object.scale * 2 * placed.base.radius < 0.3


def test_corners_do_not_reach_over_the_table_s_edge():
    cameras = cameras_that_look_at_the_edge()
    # a bar too small to count in the object's radius
    bar = sheet((0, 0, 0.02), (0.165, 0, 0), (0, 0.005, 0), spacing=0.02)
    thing = concatenate([box((0.0, 0.0, 0.1), (0.1, 0.1, 0.1), spacing=0.015), bar])
    placed = place_object(room(), thing, cameras=(cameras, cameras), options=PlaceOptions(scale=1.0, yaw_deg=0.0))
    corners = placed.target_from_object.points(thing.means)
    assert corners[:, 0].max() < 0.6


def heap(radius, low, high, *, at=(0.0, 0.0), seed=0):
    """Return small Gaussians on the side and on the flat top of a cylinder."""
    g = torch.Generator().manual_seed(seed)
    n = 1500
    angle, share = 2 * math.pi * torch.rand(n, generator=g), torch.rand(n, generator=g)
    is_top = torch.arange(n) < n // 2
    across = radius * torch.where(is_top, share.sqrt(), 1.0)
    height = torch.where(is_top, high, low + share * (high - low))
    points = torch.stack([at[0] + across * angle.cos(), at[1] + across * angle.sin(), height], 1)
    return blobs(points, 0.012, opacity_logit=4.0)


SHOULDER = TABLE + 0.6
"""Height of the flat shoulder of the captured figure; the cameras look at a point just below it."""


def figure_on_a_table():
    """Return a figure with a flat shoulder and a head, on a wide table above a floor, in different grays."""
    floor = sheet((0, 0, 0), (2, 0, 0), (0, 2, 0))
    table = sheet((0, 0, TABLE), (0.9, 0, 0), (0, 0.75, 0), spacing=0.03)
    head = heap(0.07, SHOULDER, SHOULDER + 0.2, at=(-0.14, 0.0), seed=1)
    parts = (floor, table, heap(0.22, TABLE, SHOULDER), head)
    return concatenate(
        [replace(part, sh=part.sh + tone) for part, tone in zip(parts, (-1.2, 0.5, -0.3, -0.3), strict=True)]
    )


def cameras_that_look_at_the_figure():
    return ring_of_cameras((0.0, 0, SHOULDER - 0.02))


SLENDER = box((0, 0, 0.15), (0.04, 0.04, 0.15), spacing=0.02)
"""Object that would fit on the figure's shoulder."""


def test_an_object_stands_beside_the_captured_figure_on_its_table():
    cameras = cameras_that_look_at_the_figure()
    for thing in (SLENDER, THING):
        placed = place_object(figure_on_a_table(), thing, cameras=(cameras, OWN))
        assert abs(float(placed.support.point[2]) - TABLE) < 0.02
        scale = placed.target_from_object.scale
        guess = scale_in_view(placed.base, torch.tensor([0.0, 0, SHOULDER - 0.02]), cameras=cameras)
        assert scale >= 0.5 * guess
        # outside of the figure and inside the table's edge
        assert placed.support.point[:2].norm() > 0.22 + scale * placed.base.radius
        assert placed.support.point[0].abs() < 0.9 - scale * placed.base.radius
        assert placed.support.point[1].abs() < 0.75 - scale * placed.base.radius
        assert not any(note.in_doubt for note in placed.warnings)


def test_specks_above_the_table_leave_it_free():
    g = torch.Generator().manual_seed(3)
    across = (torch.rand(200, 2, generator=g) - 0.5) * torch.tensor([1.8, 1.5])
    specks = blobs(torch.cat([across, torch.full((200, 1), TABLE + 0.1)], 1), 0.009, opacity_logit=4.0)
    cameras = cameras_that_look_at_the_figure()
    without, among = (
        place_object(scene, THING, cameras=(cameras, OWN))
        for scene in (figure_on_a_table(), concatenate([figure_on_a_table(), specks]))
    )
    assert among.target_from_object.scale == without.target_from_object.scale
    assert abs(float(among.support.point[2]) - TABLE) < 0.02


def test_a_bare_table_is_the_support_of_cameras_that_meet_below_it():
    # turned by a sixteenth of their distance, like a hand-held camera; the floor has four times the area
    cameras = ring_of_cameras((0.0, 0, TABLE - 0.1))
    placed = place_object(room(), THING, cameras=(cameras, OWN))
    assert abs(float(placed.support.point[2]) - TABLE) < 0.02


def full_table():
    """Return the figure among objects that leave gaps too small for the placed object, above a free floor."""
    angle = torch.arange(10) / 10 * 2 * math.pi
    things = [
        heap(0.09, TABLE, TABLE + 0.15, at=(0.45 * math.cos(a), 0.45 * math.sin(a)), seed=10 + i)
        for i, a in enumerate(angle.tolist())
    ]
    table = sheet((0, 0, TABLE), (0.54, 0, 0), (0, 0.54, 0), spacing=0.03)
    floor = sheet((0, 0, 0), (2, 0, 0), (0, 2, 0))
    return concatenate([replace(floor, sh=floor.sh - 1.2), table, heap(0.22, TABLE, SHOULDER), *things])


def test_a_table_too_full_for_half_of_the_guess_is_refused_with_a_picture(tmp_path, capsys):
    cameras = cameras_that_look_at_the_figure()
    with pytest.raises(
        NoFreePlaceError, match=r"at half of its guessed size or more, found one for \d\d% of it"
    ) as error:
        place_object(full_table(), THING, cameras=(cameras, OWN))
    # green marks the visible free rim of the table, red the figure in the middle; the floor keeps its gray
    tint = error.value.picture[..., 1] - error.value.picture[..., 0]
    assert float((tint > 0.1).float().mean()) > 0.01
    assert tint[50:70, 75:85].max() < -0.1
    assert (tint[:, :5].abs() < 0.01).all()
    # a given scale is never refused
    placed = place_object(full_table(), THING, cameras=(cameras, OWN), options=PlaceOptions(scale=1.0))
    assert abs(float(placed.support.point[2])) < 0.02
    assert any("lower level" in note.text for note in placed.warnings)
    write_gaussians(tmp_path / "target.ply", full_table())
    write_gaussians(tmp_path / "object.ply", THING)
    for name, seen in (("cameras", cameras), ("object-cameras", OWN)):
        images = tuple(tmp_path / f"{image}.png" for image in seen.names)
        (tmp_path / name).mkdir()
        write_capture(tmp_path / name, PosedImages(images, seen, torch.zeros(0, 3), torch.zeros(0, 3)))
    paths = {"target": "target.ply", "object": "object.ply", "cameras": "cameras", "object-cameras": "object-cameras"}
    words = ["compose", *(x for key, path in paths.items() for x in (f"--{key}", str(tmp_path / path)))]
    words += ["--out", str(tmp_path / "composite")]
    picture = tmp_path / "composite_free_places.png"
    assert main(words) == 2
    assert f"name a place (--at or --on) or a size (--scale); {picture} shows" in capsys.readouterr().err
    assert read_rgb(picture).shape == (120, 160, 3)
    assert not (tmp_path / "composite").exists()
    assert main([*words, "--scale", "1.0"]) == 0
    assert not picture.exists()
