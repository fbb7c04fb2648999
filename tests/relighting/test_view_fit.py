"""The fit of shadows to views: which Gaussians a view has, and the solver against dense matrices."""

import math

import torch

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.shadows import view_fit
from splatgraft.relighting.shadows.view_fit import _FittedView, _solved, gaussians_in_view
from splatgraft.rendering import view_operator


def cloud(count: int, *, seed: int) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(0.5 * draw(count, 3), -2 + 0.3 * draw(count, 3), draw(count, 4), draw(count), draw(count, 1, 3))


def around(views: int) -> Cameras:
    angle = torch.arange(views) / views * 2 * math.pi
    eyes = torch.stack([2 * angle.cos(), 2 * angle.sin(), torch.full((views,), 0.7)], 1)
    return pinhole(look_at(eyes, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])), 40.0, width=40, height=32)


def test_a_view_has_the_gaussians_whose_centres_project_to_its_surroundings():
    scene, camera = cloud(4000, seed=0), around(3)[1].cropped([(5, 3, 30, 20)])
    widths = scene.scales.max(1).values
    which, drawn = gaussians_in_view(scene.means, widths, camera)
    local = scene.means.double() @ camera.camera_from_world[0, :3, :3].double().T
    local = local + camera.camera_from_world[0, :3, 3]
    seen = local @ camera.intrinsics[0].double().T
    pixels, px = seen[:, :2] / seen[:, 2:], widths * camera.intrinsics[0, 0, 0] / local[:, 2]
    beside = torch.maximum(-pixels, pixels - camera.sizes[0]).amax(1) / px
    wanted = (local[:, 2] > 0) & (beside < 3)
    found = torch.zeros(4000, dtype=torch.bool)
    found[which] = True
    # float32 coordinates of some ten pixels, over widths of a pixel and more
    clear = (beside - 3).abs() > 1e-4
    assert torch.equal(found[clear], wanted[clear])
    assert 100 < len(which) < 3900
    assert torch.allclose(drawn.double(), px[which].double(), rtol=1e-5)


def test_the_solver_equals_sirt_with_dense_matrices():
    scene, cameras = cloud(120, seed=1), around(3)
    generator = torch.Generator().manual_seed(2)
    receivers, values = 80, 0.5 + 0.5 * torch.rand(80, generator=generator)
    views, matrices = [], []
    for camera in cameras:
        which, drawn = gaussians_in_view(scene.means, scene.scales.max(1).values, camera)
        operator = view_operator(scene.select(which), camera)
        first = int((which < receivers).sum())
        target = operator.alpha * (0.3 + 0.7 * torch.rand(operator.alpha.shape, generator=generator))
        directions = torch.nn.functional.normalize(scene.means[which[:first]] - camera.centers[0], dim=1)
        wide = drawn[:first] > view_fit._NARROWEST_PX
        views.append(_FittedView(which[:first], len(which), operator, target, directions, wide))
        dense = torch.zeros(target.numel(), 120)
        dense[:, which] = operator.blend(torch.eye(len(which))).reshape(-1, len(which))
        matrices.append(dense.double())
    found = _solved(values, views)

    least = view_fit._DARKEST ** (1 / view_fit._GAMMA)
    value, slope = torch.cat([values, torch.ones(40)]).double(), torch.zeros(120, 3).double()
    weight = sum(dense.sum(0) for dense in matrices)
    step = torch.where(weight > view_fit._MIN_WEIGHT, 1 / weight, 0)
    step[receivers:] = 0
    rays = [torch.nn.functional.normalize(scene.means - c.centers[0], dim=1).double() for c in cameras]
    for _ in range(view_fit._ROUNDS):
        change, turn = torch.zeros(120).double(), torch.zeros(120, 3).double()
        for dense, view, towards in zip(matrices, views, rays, strict=True):
            back = dense.T @ (view.target.flatten() - dense @ (value + (slope * towards).sum(1)))
            change, turn = change + back, turn + back[:, None] * towards
        value = torch.where(step > 0, (value + step * change).clamp(least, 1), value)
        slope = slope + step[:, None] * turn
        most = torch.minimum(view_fit._MAX_SLOPE * value, 1 - value)[:, None]
        slope = slope * (most / slope.norm(dim=1, keepdim=True).clamp_min(1e-9)).clamp_max(1)
    assert torch.equal(found[2], step[:receivers] > 0)
    # five rounds of float32 sums over some 100 pixels of size 1, divided by their weight
    assert float((found[0] - value[:receivers]).abs().max()) < 1e-4
    assert float((found[1] - slope[:receivers]).abs().max()) < 1e-4
