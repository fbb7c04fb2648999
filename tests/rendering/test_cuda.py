"""The CUDA renderer against the CPU's; needs a GPU and gsplat."""

import sys

import pytest
import torch
from shapes import camera_inside as camera
from shapes import random_scene

from splatgraft import rendering
from splatgraft.rendering import RenderOptions, cuda

ALL = frozenset({"color", "depth", "normal"})
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def test_missing_gsplat_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ValueError, match=r"splatgraft\[cuda\]"):
        cuda.render(random_scene(3, 0, seed=0), camera(), outputs=ALL, features=None, options=RenderOptions())


@needs_gpu
@pytest.mark.parametrize("low_pass", ["classic", "antialiased"])
def test_pictures_and_gradients_match_the_cpu(low_pass):
    pytest.importorskip("gsplat")
    options = RenderOptions(low_pass=low_pass, background=(0.2, 0.5, 0.9))
    features = torch.randn(200, 2, generator=torch.Generator().manual_seed(1))
    results = []
    for device in ["cpu", "cuda"]:
        scene = random_scene(200, 2, seed=1).to(device).map(lambda t: t.requires_grad_())
        picture = rendering.render(
            scene, camera().to(device), outputs=ALL, features=features.to(device), options=options
        )
        (picture.color.mean() + picture.features.mean()).backward()
        results.append((picture, scene))
    (ours, our_scene), (theirs, their_scene) = results
    # gsplat caps alpha at 0.999, the CPU at the original's 0.99: a hundredth of one layer
    for name in ["color", "alpha", "features"]:
        assert (getattr(ours, name) - getattr(theirs, name).cpu()).abs().mean() < 5e-3
    for name in ["means", "log_scales", "sh"]:
        ours, theirs = getattr(our_scene, name).grad, getattr(their_scene, name).grad.cpu()
        # the same cause
        assert (ours - theirs).norm() < 0.05 * ours.norm()


@pytest.mark.parametrize("low_pass_px2", [0.3, 0.075])
def test_planes_of_inverse_depth_are_those_of_the_kernels(low_pass_px2):
    # pure torch, so it is tested without a GPU: the CPU blends the planes as features
    options, view = RenderOptions(low_pass_px2=low_pass_px2), camera()
    scene, other = (random_scene(60, 0, seed=2).map(lambda t: t.requires_grad_()) for _ in range(2))
    ours = rendering.render(scene, view, outputs=frozenset({"inverse_depth"}), options=options).inverse_depth[0]
    planes = cuda.inverse_depth_planes(other, view, options)
    blended = rendering.render(other, view, outputs=frozenset(), features=planes, options=options)
    theirs = (blended.features[0] * view.rays()[..., [2, 0, 1]]).sum(-1)
    # float32; sums of up to 0.4
    assert (theirs - ours).abs().max() < 1e-5
    pixel_weights = torch.randn(ours.shape, generator=torch.Generator().manual_seed(3))
    (pixel_weights * ours).sum().backward()
    (pixel_weights * theirs).sum().backward()
    for name in ("means", "log_scales", "quaternions", "opacity_logits"):
        found, expected = getattr(scene, name).grad, getattr(other, name).grad
        # three sums of similar numbers instead of one, in float32
        assert (found - expected).abs().max() < 1e-3 * expected.abs().max(), name


@needs_gpu
def test_inverse_depth_matches_the_cpu():
    pytest.importorskip("gsplat")
    found = []
    for device in ["cpu", "cuda"]:
        scene = random_scene(200, 1, seed=1).to(device).map(lambda t: t.requires_grad_())
        picture = rendering.render(scene, camera().to(device), outputs=frozenset({"color", "depth", "inverse_depth"}))
        picture.inverse_depth.mean().backward()
        found.append((picture, scene.means.grad))
    (ours, our_grad), (theirs, their_grad) = found
    # gsplat caps alpha at 0.999, the CPU at 0.99
    assert (ours.inverse_depth - theirs.inverse_depth.cpu()).abs().mean() < 5e-3
    assert torch.equal(ours.depth, theirs.depth.cpu())
    assert (our_grad - their_grad.cpu()).norm() < 0.05 * our_grad.norm()


@needs_gpu
def test_operator_transpose_is_the_adjoint():
    pytest.importorskip("gsplat")
    operator = rendering.view_operator(random_scene(200, 0, seed=1).to("cuda"), camera().to("cuda"))
    values, image = torch.randn(200, 3, device="cuda"), torch.randn(29, 37, 3, device="cuda")
    left, right = (operator.blend(values) * image).sum(), (operator.blend_transpose(image) * values).sum()
    # float32 sums in two orders
    assert abs(left - right) < 1e-4 * operator.blend(values).norm() * image.norm()
