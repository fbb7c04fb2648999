"""The paper's consolidation: closer to the images, geometry unchanged, and resumed after a kill."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from memory_checkpoint import KilledError, MemoryCheckpoint
from shapes import ring, same_bits, surfels

from splatgraft.core.image_metrics import psnr
from splatgraft.fitting.perceptual_losses import l1
from splatgraft.rendering import render, view_operator
from splatgraft_paper.consolidation import PaperDescent, descend_as_paper

PAPER = PaperDescent(loss=l1, iterations=24)


def test_comes_closer_to_the_images_and_keeps_the_geometry(relit):
    out = descend_as_paper(relit.composite, relit.cameras, relit.images, PAPER)
    assert same_bits(replace(out, sh=relit.composite.sh), relit.composite)
    before, after = (render(scene, relit.cameras).color for scene in (relit.composite, out))
    truth = torch.stack(relit.images)
    assert float(psnr(after, truth)) > float(psnr(before, truth))


def test_a_killed_descent_resumes_to_the_same_bits(relit, monkeypatch):
    monkeypatch.setattr("splatgraft.consolidation.color_fit._SAVE_EVERY", 8)
    whole = descend_as_paper(relit.composite, relit.cameras, relit.images, PAPER)
    memory = MemoryCheckpoint()

    def die(done, total, message):
        if done == 19:
            raise KilledError

    with pytest.raises(KilledError):
        descend_as_paper(relit.composite, relit.cameras, relit.images, PAPER, progress=die, checkpoint=memory)
    assert memory.state is not None
    assert memory.state["iteration"] == 16
    resumed = descend_as_paper(relit.composite, relit.cameras, relit.images, PAPER, checkpoint=memory)
    assert torch.equal(resumed.sh, whole.sh)


def test_two_steps_are_adam_on_the_loss_alone_from_band_0():
    rng = np.random.default_rng(0)
    points = torch.from_numpy(rng.uniform(-0.5, 0.5, (6, 3))).float()
    scene = surfels(points, torch.nn.functional.normalize(points, dim=1), width=0.2, srgb=0.6)
    cameras = ring(2, size=(32, 24), focal=30.0)
    scene = replace(scene, sh=torch.cat([scene.sh, torch.from_numpy(rng.normal(0, 0.1, (6, 3, 3))).float()], 1))
    images = [torch.from_numpy(rng.uniform(0, 1, (24, 32, 3))).float() for _ in range(2)]
    seen = []

    def loss(picture, target):
        seen.append((picture.detach().double().numpy(), target.double().numpy()))
        return ((picture - target) ** 2).mean()

    found = descend_as_paper(scene, cameras, images, PaperDescent(loss, iterations=2)).sh.double().numpy()
    # the same in numpy: blending weights, SH of degree 1, and Kingma and Ba 2015, Algorithm 1
    weights = [view_operator(scene, camera).blend(torch.eye(6)).double().numpy() for camera in (cameras[0], cameras[1])]
    centers, means = cameras.centers.double().numpy(), scene.means.double().numpy()
    sh = scene.sh.double().numpy().copy()
    sh[:, 1:] = 0  # section 6: the higher bands are reset
    # 3DGS's rates of the features, 0.0025 and a twentieth of it for the higher bands
    rates = np.array([0.0025, *[0.0025 / 20] * 3])[None, :, None]
    first, second, order = np.zeros_like(sh), np.zeros_like(sh), []
    assert len(seen) == 2
    for step, (picture, target) in enumerate(seen, 1):
        (index,) = (i for i in range(2) if np.array_equal(target, images[i].double().numpy()))
        order.append(index)
        x, y, z = ((means - centers[index]) / np.linalg.norm(means - centers[index], axis=1, keepdims=True)).T
        basis = np.stack([np.full(6, 0.28209479), -0.48860251 * y, 0.48860251 * z, -0.48860251 * x], 1)
        colors = np.einsum("nk,nkc->nc", basis, sh) + 0.5
        assert (colors > 0).all()
        # float32 sums of six weights
        assert np.abs(weights[index] @ colors - picture).max() < 1e-5
        residual = 2 * (weights[index] @ colors - target) / target.size
        gradient = basis[:, :, None] * np.einsum("hwn,hwc->nc", weights[index], residual)[:, None]
        first = 0.9 * first + 0.1 * gradient
        second = 0.999 * second + 0.001 * gradient**2
        sh -= rates * (first / (1 - 0.9**step)) / np.sqrt(second / (1 - 0.999**step))
    assert sorted(order) == [0, 1]
    # colours of 1 are rounded at 6e-8; a step of the higher bands is 1e-4
    assert np.abs(found - sh).max() < 1e-6


def test_an_update_goes_on_from_all_bands(relit):
    bands = relit.composite.with_sh_degree(1)
    bands = replace(bands, sh=bands.sh + 0.1)
    settings = replace(PAPER, iterations=0)
    assert torch.equal(
        descend_as_paper(bands, relit.cameras, relit.images, replace(settings, continued=True)).sh, bands.sh
    )
    again = descend_as_paper(bands, relit.cameras, relit.images, settings).sh
    assert torch.equal(again[:, 0], bands.sh[:, 0])
    assert not again[:, 1:].any()
