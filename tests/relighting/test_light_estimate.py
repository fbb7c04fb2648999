"""The estimated light in scenes of known light: shadow evidence, patches of a panorama, normals, splits."""

import math

import torch

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.directions import even_directions, fit_sh, frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import srgb_from_linear
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.core.spherical_harmonics import dc_from_rgb
from splatgraft.core.splitting import split_along
from splatgraft.relighting.light.direction_estimate import estimate_direction
from splatgraft.relighting.light.estimate import estimate_light
from splatgraft.relighting.light.light import Light, fit_ambient
from splatgraft.relighting.shading.normals import estimate_normals
from splatgraft.rendering import render

UP = torch.tensor([0.0, 0.0, 1.0])
REGION = BoundingSphere(torch.tensor([0.0, 0.0, 0.3]), 2.0)


def colored(points, normals, width, rgb) -> Gaussians:
    n = len(points)
    return Gaussians(
        means=points,
        log_scales=torch.tensor([width, width, 0.1 * width]).log().repeat(n, 1),
        quaternions=quaternion_from_rotation(frames_along(-normals).transpose(1, 2)),
        opacity_logits=torch.full((n,), 3.0),
        sh=dc_from_rgb(rgb)[:, None],
    )


def views():
    turn = torch.arange(12) / 12 * 2 * math.pi
    eyes = torch.stack([2.5 * turn.cos(), 2.5 * turn.sin(), torch.full((12,), 1.5)], 1)
    return pinhole(look_at(eyes, torch.zeros(3), UP), 100.0, width=128, height=96)


def sunlit_scene(sun, strength):
    """Balls on a floor of one material, lit by `sun` and an even sky; shadows by exact ray casting."""
    generator = torch.Generator().manual_seed(1)
    centers = torch.tensor([[1.0, 0.2, 0.25], [-0.6, 0.9, 0.25], [-0.7, -0.8, 0.25], [0.5, -1.1, 0.25]])
    grid = (torch.rand(12000, 2, generator=generator) - 0.5) * 5
    points = [torch.cat([grid, torch.zeros(len(grid), 1)], 1)]
    normals = [UP.repeat(len(grid), 1)]
    for center in centers:
        around = even_directions(900)
        points.append(center + 0.25 * around)
        normals.append(around)
    point, normal = torch.cat(points), torch.cat(normals)
    lit = (normal @ sun).clamp_min(0)
    for center in centers:
        away = center - point - 1e-3 * normal
        along = away @ sun
        hit = (along > 0) & ((away**2).sum(1) - along**2 < 0.25**2)
        lit = torch.where(hit & ((point - center).norm(dim=1) > 0.26), 0, lit)
    gray = 0.15 * (1 + strength * lit)
    keep = (point[:, None, :2] - centers[:, :2]).norm(dim=-1).min(1).values > 0.05
    keep |= point[:, 2] > 0.01
    return colored(point[keep], normal[keep], 0.03, srgb_from_linear(gray)[keep, None].repeat(1, 3))


def test_shadows_give_the_direction_and_strength_of_the_sun():
    sun = torch.nn.functional.normalize(torch.tensor([0.6, -0.5, 0.8]), dim=0)
    scene = sunlit_scene(sun, strength=3.0)
    found = estimate_direction(scene, estimate_normals(scene, views()), region=REGION, up=UP)
    assert found is not None
    # tried directions lie 8 degrees apart, the finer ones 2
    assert math.degrees(math.acos(float(found.direction @ sun))) < 6
    assert found.confidence > 0.5
    # within a factor of two: more is not needed for the shadow (and edges of low maps take some of it)
    assert 1.5 < float(found.strength.mean()) < 6


def test_an_even_sky_gives_no_confident_sun():
    scene = sunlit_scene(UP, strength=0.0)
    found = estimate_direction(scene, estimate_normals(scene, views()), region=REGION, up=UP)
    assert found is None or found.confidence < 0.3 or float(found.strength.mean()) < 0.2


def test_a_bright_window_is_found_in_the_panorama():
    shell = even_directions(6000)
    window = torch.nn.functional.normalize(torch.tensor([0.8, 0.3, 0.5]), dim=0)
    bright = shell @ window > math.cos(math.radians(10))
    rgb = torch.where(bright[:, None], 1.0, 0.4).repeat(1, 3)
    scene = colored(20 * shell, -shell, 0.6, rgb)
    light = estimate_light(scene, BoundingSphere(torch.tensor([0.0, 0.0, 0.3]), 0.3), views())
    assert isinstance(light, Light)
    main = light.sources[0]
    # half the patch's radius: its edge is ragged by the splats' width, 3 degrees
    assert math.degrees(math.acos(min(1.0, float(torch.tensor(main.direction) @ window)))) < 5
    assert main.confidence < 0.7  # no shadow is evidence for it


def test_a_harmonic_fit_of_half_the_sphere_recovers_an_even_light():
    around = even_directions(2000)
    ambient = fit_ambient(torch.tensor([0.2, 0.3, 0.4]))
    values = torch.tensor([0.2, 0.3, 0.4]).repeat(2000, 1)
    half = (around[:, 2] < 0).float()
    # the ridge takes a few parts in 1e3 where half is unseen
    assert torch.allclose(fit_sh(around, values, half), ambient, atol=5e-3)


def test_normals_of_a_ball_point_outwards():
    around = even_directions(3000)
    ball = colored(0.3 * around, around, 0.01, torch.full((3000, 3), 0.5))
    found = estimate_normals(ball, views())
    above = around[:, 2] > -0.2  # the cameras do not see the underside
    # neighbours lie within 3 degrees on the ball
    assert ((found.vectors * around).sum(1)[above] > math.cos(math.radians(5))).float().mean() > 0.99
    assert found.confidence[above].mean() > 0.7


def test_split_pieces_look_like_the_whole():
    one = colored(torch.tensor([[0.0, 0.0, 0.0]]), UP[None], 0.3, torch.tensor([[0.8, 0.4, 0.2]]))
    camera = pinhole(look_at(torch.tensor([[0.0, 0.3, 4.0]]), torch.zeros(3), UP), 160.0, width=96, height=96)
    for opacity in (0.1, 0.5, 0.9):
        whole = Gaussians(one.means, one.log_scales, one.quaternions, torch.logit(torch.tensor([opacity])), one.sh)
        pieces, origin = split_along(whole, torch.tensor([0]))
        assert torch.equal(origin, torch.zeros(5, dtype=torch.long))
        a, b = render(whole, camera), render(pieces, camera)
        # the table errs by up to 0.038 at opacity 0.9; each of five pieces is cut where it falls under 1/255
        assert (a.alpha - b.alpha).abs().max() < 0.038 + 5 / 255
        inside = a.alpha > 0.05
        assert ((a.alpha - b.alpha)[inside] ** 2).mean().sqrt() < 0.02
        assert torch.equal(pieces.sh, whole.sh.repeat(5, 1, 1))
