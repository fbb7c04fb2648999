"""The CPU renderer against the plain-torch reference, and properties of any renderer."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import blobs, random_scene, ring
from shapes import camera_inside as camera

from splatgraft import rendering
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, concatenate, empty
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.rendering import RenderOptions

ALL = frozenset({"color", "depth", "normal"})


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("low_pass", ["classic", "antialiased"])
def test_pictures_and_gradients_match_the_reference(degree, low_pass):
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
        if name == "depth":
            assert (theirs > 0).any()
            assert not ours.requires_grad
            continue
        # faint pixels magnify rounding in depth and normal, which are divided by the coverage
        pixel_weights = torch.randn(ours[decided].shape, generator=generator)
        pixel_weights = torch.einsum("p...,p->p...", pixel_weights, expected.alpha[0][decided].detach().float())
        found_loss = found_loss + (pixel_weights * ours[decided]).sum()
        expected_loss = expected_loss + (pixel_weights * theirs[decided]).sum()
    found_loss.backward()
    expected_loss.backward()
    pairs = [(getattr(single, field.name), getattr(double, field.name)) for field in fields(Gaussians)]
    for ours, theirs in [*pairs, (single_features, double_features)]:
        # the same arithmetic again, with differences of similar numbers: 5 digits of the largest
        assert (ours.grad - theirs.grad).abs().max() < 5e-5 * theirs.grad.abs().max()
    assert not (expected.visible & ~found.visible).any()


def test_colour_alone_matches_the_reference():
    # three channels have kernels of their own
    single = random_scene(300, 1, seed=5).map(lambda t: t.requires_grad_())
    double = single.map(lambda t: t.detach().double().requires_grad_())
    found = rendering.render(single, camera()).color[0]
    expected = reference.render(double, camera(), features=torch.zeros(300, 0).double()).color[0]
    decided = ~reference.undecided(double, camera(), RenderOptions())
    # early stop leaves out at most 1e-4 of the light, of colours up to 3
    assert (found - expected)[decided].abs().max() < 3e-4
    pixel_weights = torch.randn(found.shape, generator=torch.Generator().manual_seed(3)) * decided[..., None]
    (pixel_weights * found).sum().backward()
    (pixel_weights * expected).sum().backward()
    for field in fields(Gaussians):
        ours, theirs = getattr(single, field.name).grad, getattr(double, field.name).grad
        assert (ours - theirs).abs().max() < 3e-4 * theirs.abs().max()


def test_what_reaches_into_the_image_from_outside_is_drawn():
    # long and opaque Gaussians, whose centres are up to an image's width outside of the border
    generator, view = torch.Generator().manual_seed(4), camera()
    scene = random_scene(600, 0, seed=4)
    angle, away = 2 * math.pi * torch.rand(600, generator=generator), 1 + 2 * torch.rand(600, generator=generator)
    size = view.sizes[0].float()
    pixels = 0.5 * size + 0.75 * away[:, None] * 0.5 * size * torch.stack([angle.cos(), angle.sin()], 1)
    depth = 1 + torch.rand(600, 1, generator=generator)
    rays = torch.cat([pixels, torch.ones(600, 1)], 1) @ torch.linalg.inv(view.intrinsics[0]).T * depth
    pose = view.world_from_camera[0]
    log_scales = torch.rand(600, 3, generator=generator) * 3 - 4
    scene = replace(
        scene, means=rays @ pose[:3, :3].T + pose[:3, 3], log_scales=log_scales, opacity_logits=torch.full((600,), 9.0)
    )
    weights, order = reference.weights(scene.map(lambda t: t.double()), view, RenderOptions())
    reaching = torch.zeros(600, dtype=torch.bool)
    reaching[order[(weights > 0).any(0).any(0)]] = True
    outside = ((pixels < 0) | (pixels > size)).any(1)
    assert int((reaching & outside).sum()) > 50
    assert int((~reaching).sum()) > 50
    assert not (reaching & ~rendering.render(scene, view).visible[0]).any()


@pytest.mark.parametrize("low_pass", ["classic", "antialiased"])
def test_inverse_depth_and_its_gradients_match_the_reference(low_pass):
    options = RenderOptions(low_pass=low_pass)
    single = random_scene(60, 1, seed=1).map(lambda t: t.requires_grad_())
    double = single.map(lambda t: t.detach().double().requires_grad_())
    found = rendering.render(single, camera(), outputs=frozenset({"color", "inverse_depth"}), options=options)
    expected = reference.render(double, camera(), features=torch.zeros(60, 0).double(), options=options)
    decided = ~reference.undecided(double, camera(), options)
    generator = torch.Generator().manual_seed(3)
    losses = []
    for ours, theirs in ((found.color, expected.color), (found.inverse_depth, expected.inverse_depth)):
        # float32 and exp to 1e-6: a pixel sums tens of weights of at most 1
        assert (ours - theirs)[0][decided].abs().max() < 1e-5
        pixel_weights = torch.randn(ours.shape, generator=generator)
        pixel_weights[0, ~decided] = 0
        losses.append([(pixel_weights * ours).sum(), (pixel_weights * theirs).sum()])
    for loss in (losses[0][0] + losses[1][0], losses[0][1] + losses[1][1]):
        loss.backward()
    for field in fields(Gaussians):
        ours, theirs = getattr(single, field.name).grad, getattr(double, field.name).grad
        # the same arithmetic again, with differences of similar numbers: 5 digits of the largest
        assert (ours - theirs).abs().max() < 5e-5 * theirs.abs().max()


def test_a_flat_gaussian_has_the_depth_of_its_plane():
    # a disc that is slanted by 45 degrees, wide enough to cover the image
    slanted = rotation_from_quaternion(torch.tensor([[0.9239, 0.3827, 0.0, 0.0]]))[0]
    disc = Gaussians(
        means=torch.tensor([[0.0, 0.0, 4.0]]),
        log_scales=torch.tensor([[2.0, 2.0, 1e-4]]).log(),
        quaternions=torch.tensor([[0.9239, 0.3827, 0.0, 0.0]]),
        opacity_logits=torch.tensor([8.0]),
        sh=torch.zeros(1, 1, 3),
    )
    view = Cameras(
        torch.eye(4)[None], torch.tensor([[[80.0, 0, 32], [0, 80, 24], [0, 0, 1]]]), torch.tensor([[64, 48]]), ("a",)
    )
    drawn = rendering.render(disc, view, outputs=frozenset({"color", "depth", "inverse_depth"}))
    y, x = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    rays = torch.stack([(x - 32) / 80, (y - 24) / 80, torch.ones_like(x)], -1)
    normal = slanted[:, 2]
    expected = 4 * normal[2] / (rays @ normal)
    shown = drawn.depth[0] > 0
    assert shown[18:30, 24:40].all()
    # the low pass of 0.3 pixels, of a disc 40 pixels wide, takes 2e-4 of the slope; depth changes by 0.7 at most
    assert (drawn.depth[0] / expected - 1)[shown].abs().max() < 1e-3
    mean = drawn.inverse_depth[0] / drawn.alpha[0]
    assert (mean * expected - 1)[shown].abs().max() < 1e-3


def test_every_pixel_with_more_than_half_opacity_has_a_depth():
    # a floor seen from just above: the rims of its wide splats reach above the horizon
    floor = Gaussians(
        means=torch.cartesian_prod(torch.linspace(-3, 3, 7), torch.tensor([0.3]), torch.linspace(0.5, 6, 7)),
        log_scales=torch.tensor([[0.8, 0.001, 0.8]]).log().repeat(49, 1),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(49, 1),
        opacity_logits=torch.full((49,), 4.0),
        sh=torch.zeros(49, 1, 3),
    )
    drawn = rendering.render(floor, camera_at_origin(), outputs=frozenset({"depth"}))
    shown = drawn.alpha > 0.5 + 1e-4
    assert shown[0, 14].any()
    assert (drawn.depth[shown] > 0).all()


def camera_at_origin() -> Cameras:
    intrinsics = torch.tensor([[[20.0, 0.0, 20.0], [0.0, 20.0, 15.0], [0.0, 0.0, 1.0]]])
    return Cameras(torch.eye(4)[None], intrinsics, torch.tensor([[40, 30]]), ("a",))


def test_opaque_layers_hide_what_is_behind_them():
    # 300 discs over the whole image: the early stop must happen, and must not be visible
    n = 300
    generator = torch.Generator().manual_seed(1)
    points = torch.stack([torch.zeros(n), torch.zeros(n), torch.linspace(0, 1, n)], -1)
    scene = replace(blobs(points, math.e, opacity_logit=0.0), sh=torch.rand(n, 1, 3, generator=generator))
    found = rendering.render(scene, camera()).color[0]
    double = scene.map(to_double)
    expected = reference.render(double, camera(), features=torch.zeros(n, 0).double()).color[0]
    # 1e-4 of the light is left when drawing stops, of colours up to 0.8
    assert (found - expected).abs().max() < 1e-4


def to_double(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.double()


@pytest.mark.parametrize("degree", [0, 3])
def test_moving_scene_and_camera_together_changes_nothing(degree):
    scene = random_scene(200, degree, seed=4)
    axis = torch.nn.functional.normalize(torch.tensor([1.0, -2.0, 0.7, 0.4]), dim=0)
    turned = rotation_from_quaternion(axis[None])[0]
    moved_from_scene = Similarity(scale=1.0, rotation=turned, translation=torch.tensor([0.3, -1.2, 0.5]))
    before = rendering.render(scene, camera(), outputs=ALL)
    after = rendering.render(moved_from_scene.gaussians(scene), moved_from_scene.cameras(camera()), outputs=ALL)
    # a pixel at the edge of a splat may fall on its other side, 1/255; elsewhere float32 rounding of poses
    assert (before.color - after.color).abs().max() < 2 / 255
    assert (before.color - after.color).abs().mean() < 2e-5
    assert (before.depth - after.depth).abs().mean() < 2e-4
    normal = before.normal @ turned.T
    assert (normal - after.normal).abs().mean() < 2e-4


def test_nothing_to_draw_gives_the_background():
    options = RenderOptions(background=(0.1, 0.2, 0.3))
    picture = rendering.render(empty(2), camera(), outputs=ALL, features=torch.zeros(0, 4), options=options)
    assert torch.equal(picture.color, torch.tensor([0.1, 0.2, 0.3]).expand(1, 29, 37, 3))
    assert not any(getattr(picture, name).any() for name in ["alpha", "depth", "normal", "features", "visible"])


def test_reading_an_output_that_was_not_asked_for_is_refused():
    picture = rendering.render(random_scene(5, 0, seed=0), camera(), outputs=frozenset())
    for name in ("color", "depth", "normal", "features"):
        with pytest.raises(ValueError, match=f"render: expected {name} among the requested outputs, found none"):
            getattr(picture, name)


def test_behind_and_too_near_is_not_drawn():
    scene = random_scene(50, 0, seed=6)
    pose = camera().world_from_camera[0]
    # within the near plane, along the optical axis
    scene = replace(scene, means=pose[:3, 3] + pose[:3, 2] * torch.linspace(-3, 0.5, 50)[:, None])
    picture = rendering.render(scene, camera(), options=RenderOptions(near=0.51))
    assert not picture.alpha.any()
    assert not picture.visible.any()


def test_views_of_a_batch_are_the_single_views():
    scene, pair = random_scene(40, 1, seed=7), ring(2, size=(37, 29))
    both = rendering.render(scene, pair, outputs=ALL)
    assert both.visible.any(1).all()
    for i, single in enumerate(pair):
        alone = rendering.render(scene, single, outputs=ALL)
        assert torch.equal(both.color[i], alone.color[0])
        assert torch.equal(both.visible[i], alone.visible[0])


def test_a_tiny_image_and_a_wide_one():
    scene = random_scene(40, 0, seed=8)
    for width, height in [(1, 1), (16, 16), (65, 3)]:
        picture = rendering.render(scene, camera(width, height), outputs=ALL)
        assert picture.color.shape == (1, height, width, 3)
        expected = reference.render(scene.map(to_double), camera(width, height), features=torch.zeros(40, 0).double())
        decided = ~reference.undecided(scene.map(to_double), camera(width, height), RenderOptions())
        # as above
        assert ((picture.color - expected.color)[0] * decided[..., None]).abs().max() < 1e-5


def test_the_same_input_gives_the_same_bits():
    runs = []
    for _ in range(2):
        scene = random_scene(500, 2, seed=2).map(lambda t: t.requires_grad_())
        picture = rendering.render(scene, camera(100, 80), outputs=ALL)
        (picture.color.sin().sum() + picture.normal.sum()).backward()
        runs.append([picture.color, *(getattr(scene, field.name).grad for field in fields(Gaussians))])
    assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))


def test_cameras_of_different_sizes_are_refused():
    mixed = replace(ring(2), sizes=torch.tensor([[37, 29], [38, 29]]))
    with pytest.raises(ValueError, match="one image size"):
        rendering.render(random_scene(3, 0, seed=0), mixed)


ODD = st.sampled_from(
    [0.0, 1e-30, -1e-30, 1.0, -1.0, 50.0, -50.0, 1e4, -1e4, 1e20, float("nan"), float("inf"), -float("inf")]
)


@settings(max_examples=40, deadline=None)
@given(numbers=st.lists(ODD, min_size=22, max_size=22), low_pass=st.sampled_from(["classic", "antialiased"]))
def test_degenerate_gaussians_do_no_harm(numbers, low_pass):
    good = random_scene(20, 1, seed=3)
    mean, log_scale, quaternion, opacity, sh = torch.tensor(numbers)[None].split([3, 3, 4, 1, 11], dim=1)
    bad = Gaussians(
        means=mean,
        log_scales=log_scale,
        quaternions=quaternion,
        opacity_logits=opacity[:, 0],
        sh=torch.nn.functional.pad(sh, (0, 1)).reshape(1, 4, 3),
    )
    # the renderer does not repair colours that are not numbers
    bad = replace(bad, sh=bad.sh.nan_to_num(0, 0, 0).clamp(-10, 10))
    scene = concatenate([bad, good]).map(lambda t: t.requires_grad_())
    picture = rendering.render(scene, camera(), outputs=ALL, options=RenderOptions(low_pass=low_pass))
    assert all(getattr(picture, name).isfinite().all() for name in ["color", "alpha", "depth", "normal"])
    (picture.color.sum() + picture.alpha.sum() + picture.normal.sum()).backward()
    assert all(getattr(scene, field.name).grad.isfinite().all() for field in fields(Gaussians))


def test_two_threads_may_draw_at_once():
    scene = random_scene(200, 1, seed=9)
    expected = rendering.render(scene, camera()).color
    with ThreadPoolExecutor(2) as pool:
        pictures = list(pool.map(lambda _: rendering.render(scene, camera()).color, range(8)))
    assert all(torch.equal(picture, expected) for picture in pictures)
