"""Restriction to changes: active Gaussians and windows follow the changed pixels."""

import torch
from conftest import ball, ring

from splatgraft.consolidation import ConsolidateOptions
from splatgraft.consolidation.changed_region import drop_higher_bands, restrict_to_changes
from splatgraft.consolidation.frozen_views import Views
from splatgraft.core.gaussians import concatenate
from splatgraft.rendering import render


def views_of(scene, cameras, images) -> Views:
    return Views(scene, cameras, images, weights=None, options=ConsolidateOptions(cache_bytes=2**24))


def scene_with_a_satellite():
    far = ball(20, degree=1, seed=8)
    far = far.map(lambda tensor: tensor)
    moved = type(far)(**{**vars(far), "means": far.means * 0.2 + torch.tensor([0.0, 1.6, 0.0])})
    return concatenate([ball(150, degree=1, seed=7), moved])


def test_nothing_moves_where_nothing_changed():
    scene, cameras = scene_with_a_satellite(), ring(4)
    views = restrict_to_changes(views_of(scene, cameras, list(render(scene, cameras).color)), 2 / 255)
    assert len(views) == 0


def test_only_what_changed_pixels_see_moves():
    scene, cameras = scene_with_a_satellite(), ring(4)
    darker = type(scene)(**{**vars(scene), "sh": torch.cat([scene.sh[:150], scene.sh[150:] - 1.0])})
    views = restrict_to_changes(views_of(scene, cameras, list(render(darker, cameras).color)), 2 / 255)
    assert views.active is not None
    active = torch.zeros(170, dtype=torch.bool)
    active[views.active] = True
    visible = render(scene, cameras).visible.any(0)
    assert bool(active[150:][visible[150:]].float().mean() > 0.9)
    assert float(active[:150].float().mean()) < 0.5
    # windows hold the satellite, not the whole picture
    assert bool((views.cameras.sizes.prod(1) < 48 * 48).all())


def test_zero_switches_it_off():
    scene, cameras = scene_with_a_satellite(), ring(2)
    views = views_of(scene, cameras, list(render(scene, cameras).color))
    assert restrict_to_changes(views, 0.0) is views


def test_reset_keeps_band_zero_alone():
    sh = ball(5, degree=3, seed=0).sh
    assert torch.equal(drop_higher_bands(sh)[:, :1], sh[:, :1])
    assert not drop_higher_bands(sh)[:, 1:].any()
