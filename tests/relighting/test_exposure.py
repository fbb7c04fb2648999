"""Transfer by one gain per object on synthetic rooms: the known ratio is found; unknown sources change nothing."""

import math
from dataclasses import fields

import pytest
import torch

from splatgraft.composition import compose
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import Gaussians, empty
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import dc_from_rgb, rgb_from_dc
from splatgraft.relighting.gain import relight_by_gain
from splatgraft.relighting.transfer import SourceScene


def shell(color, *, n=2500, radius=2.0, spread=0.12):
    i = torch.arange(n) + 0.5
    z, azimuth = 1 - 2 * i / n, i * (math.pi * (3 - math.sqrt(5)))
    ring = (1 - z * z).sqrt()
    directions = torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), z], -1)
    return Gaussians(
        means=directions * radius,
        log_scales=torch.full((n, 3), math.log(spread)),
        quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        opacity_logits=torch.full((n,), 8.0),
        sh=dc_from_rgb(torch.tensor(color)).expand(n, 1, 3).clone(),
    )


def cameras():
    eyes = torch.tensor([[1.5, 0.0, 0.5], [0.0, 1.5, 0.5], [-1.5, 0.0, 0.5], [0.0, -1.5, 0.5]])
    up = torch.tensor([0.0, 0, 1])
    return pinhole(look_at(eyes, torch.zeros(3), up), 100.0, width=64, height=48)


MOVE = Similarity(
    scale=1.0,
    rotation=rotation_from_quaternion(torch.tensor([[0.9, 0.0, 0.0, 0.4]]))[0],
    translation=torch.tensor([0.2, 0.1, 0.0]),
)


def test_the_ratio_of_two_uniform_rooms_is_put_on_the_object():
    light = torch.tensor([1.5, 1.0, 0.8])
    source_color = torch.tensor([0.5, 0.5, 0.5])
    target_color = srgb_from_linear(linear_from_srgb(source_color) * light)
    thing = shell([0.4, 0.5, 0.6], n=200, radius=0.1, spread=0.02)
    composite = compose(shell(target_color.tolist()), [thing], target_from_objects=[MOVE])
    source = SourceScene(shell(source_color.tolist()), cameras())
    relit, report = relight_by_gain(composite, cameras(), sources=[source])
    before, after = (linear_from_srgb(rgb_from_dc(c.objects[0].gaussians.sh[:, 0])) for c in (composite, relit))
    # uniform shells give their colour in every pixel; opacity of 0.9997 and coverage of over 0.99 leave 1%
    assert torch.allclose(after / before, light.expand(200, 3), rtol=0.01)
    assert "Exposure and white balance" in report[0].text
    assert torch.equal(relit.target.sh, composite.target.sh)


@pytest.mark.parametrize("scene", [empty(), None])
def test_an_unknown_or_empty_source_changes_no_bit(scene):
    thing = shell([0.4, 0.5, 0.6], n=200, radius=0.1, spread=0.02)
    composite = compose(shell([0.5, 0.5, 0.5]), [thing, empty()], target_from_objects=[MOVE, MOVE])
    source = None if scene is None else SourceScene(scene, cameras())
    relit, report = relight_by_gain(composite, cameras(), sources=[source, None])
    for field in fields(Gaussians):
        same = (getattr(c.objects[0].gaussians, field.name) for c in (composite, relit))
        assert torch.equal(*same)
    assert all("pasted as it is" in note.text and note.in_doubt for note in report)


def test_one_source_per_object_is_required():
    composite = compose(shell([0.5, 0.5, 0.5]), [], target_from_objects=[])
    assert relight_by_gain(composite, cameras(), sources=[])[1] == ()
    with pytest.raises(ValueError, match="expected 0 source scenes, found 1"):
        relight_by_gain(composite, cameras(), sources=[None])
