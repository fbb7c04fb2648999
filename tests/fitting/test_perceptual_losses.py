"""Perceptual losses: zero for equal images, gradients, LPIPS with given weights."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from random_lpips import write_random_lpips

from splatgraft.fitting.perceptual_losses import HEADS_FILE, VGG_FILE, l1, lpips_vgg, windowed_fourier


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def reference_fourier(image: np.ndarray, target: np.ndarray, size: int = 16, weight: float = 0.1) -> float:
    """Compute the loss window by window with numpy's full FFT."""
    hop, (h, w, _) = size // 2, image.shape
    ramp = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(size) / size)
    window = np.outer(ramp, ramp)
    window /= np.sqrt((window**2).mean())
    pads = ((hop, hop + -h % hop), (hop, hop + -w % hop), (0, 0))
    image_padded, target_padded = np.pad(image, pads, mode="edge"), np.pad(target, pads, mode="edge")
    parts = []
    for top in range(0, image_padded.shape[0] - size + 1, hop):
        for left in range(0, image_padded.shape[1] - size + 1, hop):
            for channel in range(3):
                cut = (slice(top, top + size), slice(left, left + size), channel)
                a, b = (np.abs(np.fft.fft2(p[cut] * window)) / size for p in (image_padded, target_padded))
                parts.append(np.abs(a - b).mean())
    return float(np.mean(parts) + weight * np.abs(image - target).mean())


@pytest.mark.parametrize("shape", [(48, 64), (37, 51), (16, 16), (9, 40)])
def test_fourier_equals_the_plain_definition(shape):
    image, target = noise(*shape, 3), noise(*shape, 3, seed=1)
    wanted = reference_fourier(image.double().numpy(), target.double().numpy())
    # float32 FFTs of 256 numbers of size 1: relative 1e-6, averaged
    assert float(windowed_fourier(image, target)) == pytest.approx(wanted, rel=1e-5)


def test_fourier_is_differentiable_and_zero_at_the_target():
    image, target = noise(20, 24, 3).double().requires_grad_(), noise(20, 24, 3, seed=1).double()
    assert float(windowed_fourier(target, target)) == 0
    assert torch.autograd.gradcheck(lambda x: windowed_fourier(x, target), image, atol=1e-6)


@pytest.mark.parametrize("shape", [(48, 64), (37, 51), (9, 40)])
def test_fourier_has_the_same_gradient_in_single_precision(shape):
    image, target = noise(*shape, 3), noise(*shape, 3, seed=1)
    target[:4] = image[:4] = 0  # windows without light have a gradient of 0

    def gradient(x):
        x = x.requires_grad_()
        return torch.autograd.grad(3 * windowed_fourier(x, target.to(x)), x)[0]

    wanted = gradient(image.double())
    # float32 transforms of 256 numbers of size 1, each magnitude's direction to 1e-5, summed over 4 windows
    assert float((gradient(image) - wanted).norm() / wanted.norm()) < 1e-4


def test_fourier_forgives_a_shift_that_l1_does_not():
    # edges a pixel apart: an average of the two is optimal for L1, and bad for the magnitudes
    edges = (noise(64, 64, 3) > 0.5).float()
    edges = F.interpolate(edges.permute(2, 0, 1)[None, :, ::8, ::8], scale_factor=8)[0].permute(1, 2, 0)
    shifted = edges.roll(1, 1)
    average = 0.5 * (edges + shifted)
    assert float(l1(average, shifted)) < 0.6 * float(l1(edges, shifted))
    assert float(windowed_fourier(edges, shifted)) < float(windowed_fourier(average, shifted))


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Write files in the layout of the published ones, with random numbers."""
    folder = tmp_path_factory.mktemp("weights")
    write_random_lpips(folder)
    return folder


def reference_lpips(folder, image: torch.Tensor, target: torch.Tensor) -> float:
    """Return LPIPS by VGG-16 in torchvision's list of layers, cut at LPIPS's taps."""
    vgg, heads = (torch.load(folder / name, weights_only=True) for name in (VGG_FILE, HEADS_FILE))
    layers: list[torch.nn.Module] = []
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if width == 0:
            layers.append(torch.nn.MaxPool2d(2))
            continue
        weight = vgg[f"features.{len(layers)}.weight"]
        convolution = torch.nn.Conv2d(weight.shape[1], width, 3, padding=1)
        convolution.load_state_dict({"weight": weight, "bias": vgg[f"features.{len(layers)}.bias"]})
        layers += [convolution, torch.nn.ReLU()]
    mean, deviation = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    both = torch.stack([((x * 2 - 1) - mean) / deviation for x in (image, target)]).permute(0, 3, 1, 2)
    total, tap = 0.0, 0
    with torch.no_grad():
        for index, layer in enumerate(layers):
            both = layer(both)
            if index in (3, 8, 15, 22, 29):
                unit = both / (both.norm(dim=1, keepdim=True) + 1e-10)
                squares = (unit[0] - unit[1]) ** 2
                total += float((squares * heads[f"lin{tap}.model.1.weight"][0]).sum(0).mean())
                tap += 1
    return total


def test_lpips_has_the_published_structure(weights):
    image, target = noise(33, 47, 3), noise(33, 47, 3, seed=1)
    loss = lpips_vgg(weights)
    # the same float32 convolutions; sums in another order
    assert float(loss(image, target)) == pytest.approx(reference_lpips(weights, image, target), rel=1e-4)
    assert float(loss(target, target)) == 0


def test_lpips_of_3dgs_gives_the_network_pictures_from_0_to_1(weights):
    a, b = torch.rand(2, 24, 32, 3, generator=torch.Generator().manual_seed(3))
    published, of_3dgs = lpips_vgg(weights), lpips_vgg(weights, black=0)
    # the published scaling maps x to 2 x - 1, so these pictures reach the network as a and b
    expected = published((a + 1) / 2, (b + 1) / 2)
    assert float(of_3dgs(a, b)) == pytest.approx(float(expected), rel=1e-4)  # float32 through 13 layers
    assert float(of_3dgs(a, b)) != pytest.approx(float(published(a, b)), rel=0.01)


def test_the_networks_weights_are_copied_once(weights, monkeypatch):
    loss, copied, original = lpips_vgg(weights), [], torch.Tensor.to

    def to(tensor, *where, **options):
        moved = original(tensor, *where, **options)
        copied.append(0 if moved is tensor else moved.numel())
        return moved

    monkeypatch.setattr(torch.Tensor, "to", to)
    image, target = noise(16, 16, 3, seed=0).double(), noise(16, 16, 3, seed=1).double()
    first = loss(image, target)
    # VGG-16's convolutions have 14.7 million weights
    assert 14e6 < sum(copied) < 16e6
    copied.clear()
    assert loss(image, target) == first
    assert sum(copied) < 1000


def test_lpips_says_where_missing_weights_belong(tmp_path):
    with pytest.raises(ValueError, match=rf"{VGG_FILE}: expected weights .* put both there") as caught:
        lpips_vgg(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("spoil", ["text", "list", "key", "shape", "nan"])
def test_lpips_refuses_other_files(weights, tmp_path, spoil):
    (tmp_path / VGG_FILE).write_bytes((weights / VGG_FILE).read_bytes())
    heads = torch.load(weights / HEADS_FILE, weights_only=True)
    key = "lin2.model.1.weight"
    if spoil == "key":
        heads["lin2"] = heads.pop(key)
    if spoil == "shape":
        heads[key] = heads[key][:, :9]
    if spoil == "nan":
        heads[key] = heads[key] * float("nan")
    torch.save([1] if spoil == "list" else heads, tmp_path / HEADS_FILE)
    if spoil == "text":
        (tmp_path / HEADS_FILE).write_text("not weights")
    with pytest.raises(ValueError, match=HEADS_FILE) as caught:
        lpips_vgg(tmp_path)
    assert "\n" not in str(caught.value)


def test_lpips_refuses_tiny_images(weights):
    with pytest.raises(ValueError, match="16x16"):
        lpips_vgg(weights)(noise(8, 20, 3), noise(8, 20, 3))
