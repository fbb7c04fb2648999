"""Views of a composite, and methods by name: `none` keeps the prior, views are harmonised independently."""

from dataclasses import replace

import pytest
import torch
from shapes import blobs

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.harmonization import harmonize, make_harmonizer, render_views
from splatgraft.rendering import render


def spheres(count: int, seed: int, rgb: tuple[float, float, float]) -> Gaussians:
    means = 0.4 * torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return blobs(means, 0.08, srgb=rgb, opacity_logit=2.0)


def cameras() -> Cameras:
    eyes = torch.tensor([[2.0, 0, 0.5], [0, 2.0, 0.5], [-2.0, 0, 0.5]])
    return pinhole(look_at(eyes, torch.zeros(3), torch.tensor([0.0, 0, 1])), 40.0, width=40, height=32)


def scene() -> tuple[Gaussians, torch.Tensor]:
    """Return a composite of 60 Gaussians; the last 20 are the object's."""
    whole = concatenate([spheres(40, 0, (0.2, 0.5, 0.7)), spheres(20, 1, (0.9, 0.3, 0.1))])
    return whole, torch.arange(60) >= 40


def test_a_view_shows_composite_background_object_and_prior() -> None:
    composite, is_object = scene()
    prior = replace(composite, sh=composite.sh - 0.1)
    views = render_views(composite, is_object, cameras(), prior=prior)
    coverage = is_object[:, None].float()
    assert len(views) == 3
    for view, camera in zip(views, cameras(), strict=True):
        drawn = render(composite, camera, outputs=frozenset({"color", "depth"}), features=coverage)
        assert torch.equal(view.composite, drawn.color[0].clamp(0, 1))
        assert torch.equal(view.depth, drawn.depth[0])
        assert torch.equal(view.background, render(composite.select(~is_object), camera).color[0].clamp(0, 1))
        assert torch.equal(view.prior, render(prior, camera).color[0].clamp(0, 1))
        assert torch.equal(view.mask, drawn.features[0, ..., 0].clamp(0, 1))


def test_without_a_prior_it_is_the_composite_and_other_flags_are_refused() -> None:
    composite, is_object = scene()
    for view in render_views(composite, is_object, cameras()):
        assert torch.equal(view.prior, view.composite)
    with pytest.raises(ValueError, match="expected one flag for each of 60 Gaussians, found 59"):
        render_views(composite, is_object[1:], cameras())


def test_without_an_image_model_all_views_keep_the_prior() -> None:
    composite, is_object = scene()
    views = render_views(composite, is_object, cameras(), prior=replace(composite, sh=composite.sh - 0.1))
    calls: list[tuple[int, int]] = []
    found = harmonize(views, "none", progress=lambda done, total, text: calls.append((done, total)))
    assert all(torch.equal(image, view.prior) for image, view in zip(found, views, strict=True))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert len(harmonize(views, make_harmonizer("none"))) == 3
