"""Normal equations: equal to a dense solve, priors, choice of the ridge, tints."""

from dataclasses import replace

import torch
from ball_scenes import ball, basis_towards, ring, views_of

from splatgraft.consolidation import normal_equations
from splatgraft.consolidation.color_fit import drop_higher_bands
from splatgraft.consolidation.normal_equations import _build_equations, _select_ridge, solve
from splatgraft.consolidation.view_errors import CorrectedTargets
from splatgraft.rendering import render


def test_equals_dense_ridge_regression(monkeypatch):
    # colours far above the clamp, so that the problem is linear
    scene = ball(40, degree=1, seed=3)
    scene = replace(scene, sh=scene.sh.abs() * torch.tensor([1.0, 0.1, 0.1, 0.1])[:, None] + 0.2)
    cameras = ring(5, 32)
    generator = torch.Generator().manual_seed(4)
    images = [torch.rand(32, 32, 3, generator=generator) for _ in range(5)]
    for name, value in {"_ROUNDS": 1, "_STEPS": 120, "_PRIOR_PX": 0.5, "_BAND_RIDGES": (0.1,)}.items():
        monkeypatch.setattr(normal_equations, name, value)
    prior = scene.sh.clone()
    views = views_of(scene, cameras, images)
    found = solve(prior, CorrectedTargets(views, estimated=False))

    rows, right, seen = [], [], torch.zeros(40, dtype=torch.float64)
    for index in range(5):
        blend = views[index].operator.blend(torch.eye(40)).reshape(-1, 40).double()
        design = (blend[:, :, None] * basis_towards(scene, cameras[index]).double()[None]).reshape(-1, 160)
        rows.append(design)
        right.append(images[index].reshape(-1, 3).double() - 0.5 * blend.sum(1, keepdim=True))
        seen += blend.T @ blend.sum(1)
    ridge = (torch.tensor([0.0, 0.1, 0.1, 0.1], dtype=torch.float64) * seen[:, None] + 0.5).flatten()
    matrix, vector = torch.cat(rows), torch.cat(right)
    flat = prior.reshape(160, 3).double()
    wanted = torch.linalg.solve(
        matrix.T @ matrix + torch.diag(ridge), matrix.T @ vector + ridge[:, None] * flat
    ).reshape(40, 4, 3)
    # float32 conjugate gradient: 120 steps of relative rounding 6e-8 on numbers of size 1 under a condition number
    # of about 1e2 after preconditioning
    assert float((found.double() - wanted).abs().max()) < 2e-3


def test_an_unseen_gaussian_keeps_its_prior():
    scene = ball(60, degree=1, seed=5)
    scene = replace(scene, means=torch.cat([scene.means[:50], scene.means[50:] + 40.0]))
    cameras = ring(4, 32)
    images = list(0.5 * render(scene, cameras).color)
    prior = scene.sh.clone()
    found = solve(prior, CorrectedTargets(views_of(scene, cameras, images), estimated=False))
    assert torch.equal(found[50:], prior[50:])
    assert not torch.equal(found[:50], prior[:50])


def test_the_ridge_follows_how_much_the_views_disagree(monkeypatch):
    scene, cameras = ball(200, degree=2, seed=6), ring(12)
    images = render(scene, cameras).color
    prior = drop_higher_bands(scene.sh)
    monkeypatch.setattr(normal_equations, "_BAND_RIDGES", (0.001, 0.1, 10.0))

    def chosen(pictures) -> float:
        targets = CorrectedTargets(views_of(scene, cameras, list(pictures)), estimated=False)
        equations = _build_equations(prior, targets.views, 0.1)
        return _select_ridge(prior, targets, equations)

    # the scene has higher bands, and views that agree show them; a gain of 40% per view drowns them
    gains = torch.exp(0.4 * torch.randn(12, 1, 1, 3, generator=torch.Generator().manual_seed(7)))
    assert chosen(images) < chosen(images * gains)


def test_tints_are_taken_off_before_the_colours_are_fitted():
    scene, cameras = ball(300, degree=1, seed=9), ring(12)
    images = render(scene, cameras).color
    gains = torch.exp(0.1 * torch.randn(12, 1, 1, 3, generator=torch.Generator().manual_seed(10)))
    gains /= gains.log().mean(0, keepdim=True).exp()  # the mean gain is the scene's
    prior = drop_higher_bands(scene.sh)

    def error(estimated) -> float:
        targets = CorrectedTargets(views_of(scene, cameras, list(images * gains)), estimated)
        found = replace(scene, sh=solve(prior, targets))
        return float((render(found, cameras).color - images).square().mean().sqrt())

    assert error(True) < error(False)
