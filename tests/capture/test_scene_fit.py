"""A trained scene beside its capture: one that lies elsewhere is said to, with the axes in which it would fit."""

import pytest
import torch

from splatgraft.capture import misfit_of
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats import SceneFile
from splatgraft.formats.scenes.axes import change_axes, rdf_from


def table(n: int = 3000) -> Gaussians:
    """A surface without symmetry: a wide plate and a tower off its middle."""
    g = torch.Generator().manual_seed(0)
    means = torch.rand(n, 3, generator=g) * torch.tensor([4.0, 0.1, 2.0])
    means[: n // 4] = torch.rand(n // 4, 3, generator=g) * torch.tensor([0.3, -2.0, 0.4]) + torch.tensor([0.5, 0, 0.2])
    return Gaussians(
        means=means,
        log_scales=torch.full((n, 3), -4.0),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4).clone(),
        opacity_logits=torch.zeros(n),
        sh=torch.zeros(n, 1, 3),
    )


def test_a_scene_where_its_points_are_is_not_mentioned():
    scene = table()
    assert misfit_of(SceneFile(scene), scene.means[::7] + 0.005) is None


@pytest.mark.parametrize("axes", ["RUB", "LUF", "RFU"])
def test_axes_in_which_it_would_fit_are_named(axes):
    scene = table()
    wrong = change_axes(scene, rdf_from(axes).T)  # read as RDF, though it is `axes`
    assert f'set axes = "{axes}"' in (misfit_of(SceneFile(wrong), scene.means[::7]) or "")


def test_a_scene_of_another_frame_is_said_to_be():
    scene = table()
    said = misfit_of(SceneFile(scene), 10 * scene.means[::7] + 3)
    assert "another frame" in (said or "")


def test_few_points_say_nothing():
    assert misfit_of(SceneFile(table()), torch.randn(5, 3) * 100) is None
