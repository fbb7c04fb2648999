"""The CPU renderer against the plain-torch reference, and the properties a renderer has of itself."""

import pytest
import reference
import torch

from splatgraft import rendering
from splatgraft.cameras import Cameras, look_at, pinhole
from splatgraft.gaussians import Gaussians, empty
from splatgraft.rendering import RenderOptions

ALL = frozenset({"color", "depth", "normal"})


def random_scene(n: int, degree: int, seed: int) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=normal(n, 3),
        log_scales=normal(n, 3) * 0.6 - 2.5,
        quaternions=normal(n, 4),
        opacity_logits=normal(n) * 1.5 + 0.5,
        sh=normal(n, (degree + 1) ** 2, 3) * 0.4,
    )


def camera(width: int = 37, height: int = 29) -> Cameras:
    pose = look_at(torch.tensor([[0.5, 0.3, -2.2]]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    return pinhole(pose, 40.0, width=width, height=height)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("low_pass", ["classic", "antialiased"])
def test_picture_and_gradient_match_the_reference(degree, low_pass):
    options = RenderOptions(low_pass=low_pass, background=(0.2, 0.5, 0.9))
    single = random_scene(60, degree, seed=degree).map(lambda t: t.requires_grad_())
    double = single.map(lambda t: t.detach().double().requires_grad_())
    generator = torch.Generator().manual_seed(9)
    single_features = torch.randn(60, 2, generator=generator).requires_grad_()
    double_features = single_features.detach().double().requires_grad_()
    found = rendering.render(single, camera(), outputs=ALL, features=single_features, options=options)
    expected = reference.render(double, camera(), features=double_features, options=options)
    decided = ~reference.undecided(double, camera(), options)
    found_loss, expected_loss = torch.zeros(()), torch.zeros((), dtype=torch.float64)
    # float32 and exp to 1e-6: a pixel sums tens of weights of at most 1, values of a few units
    for name, tolerance in [("color", 1e-5), ("alpha", 1e-5), ("depth", 1e-4), ("normal", 5e-5), ("features", 2e-5)]:
        ours, theirs = getattr(found, name)[0], getattr(expected, name)[0]
        assert (ours - theirs)[decided].abs().max() < tolerance, name
        # faint pixels magnify rounding in depth and normal, which are divided by how much there is
        pixel_weights = torch.randn(ours[decided].shape, generator=generator)
        pixel_weights = torch.einsum("p...,p->p...", pixel_weights, expected.alpha[0][decided].detach().float())
        found_loss = found_loss + (pixel_weights * ours[decided]).sum()
        expected_loss = expected_loss + (pixel_weights * theirs[decided]).sum()
    found_loss.backward()
    expected_loss.backward()
    pairs = [(getattr(single, f), getattr(double, f)) for f in Gaussians.__dataclass_fields__]
    for ours, theirs in [*pairs, (single_features, double_features)]:
        # the same arithmetic once more, with differences of like numbers: 5 digits of the largest
        assert (ours.grad - theirs.grad).abs().max() < 5e-5 * theirs.grad.abs().max()
    assert not (expected.visible & ~found.visible).any()


def test_nothing_to_draw_gives_the_background():
    picture = rendering.render(empty(2), camera(), outputs=ALL, options=RenderOptions(background=(0.1, 0.2, 0.3)))
    assert torch.equal(picture.color, torch.tensor([0.1, 0.2, 0.3]).expand(1, 29, 37, 3))
    assert not picture.alpha.any()
    assert not picture.depth.any()
    assert not picture.normal.any()
