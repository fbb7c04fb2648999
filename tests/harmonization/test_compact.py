"""The compact harmoniser: identity before training, texture only scaled, weights written and read back."""

from dataclasses import replace

import pytest
import torch

from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.harmonization import CompactOptions, HarmonizerInputs, make_harmonizer
from splatgraft.harmonization.compact.features import apply_output, compact_input
from splatgraft.harmonization.compact.harmonizer import Compact
from splatgraft.harmonization.compact.network import CompactNetwork, CompactSize, read_weights, write_weights

TINY = CompactSize(widths=(8, 8, 16, 16), blocks=(1, 1, 1, 1), heads=2)


def example(h=45, w=70):
    g = torch.Generator().manual_seed(0)
    background = torch.rand(h, w, 3, generator=g)
    mask = torch.zeros(h, w)
    mask[h // 4 : 2 * h // 3, w // 4 : 2 * w // 3] = 1
    composite = torch.where(mask[..., None] > 0, 0.1 + 0.8 * torch.rand(h, w, 3, generator=g), background)
    normal = torch.nn.functional.normalize(torch.randn(h, w, 3, generator=g), dim=-1)
    prior = (composite * (0.5 + 0.5 * torch.rand(h, w, 1, generator=g))).clamp(0, 1)
    return HarmonizerInputs(
        composite, background, mask, 1 + torch.rand(h, w, generator=g), normal, prior, prior_confidence=0.5
    )


def moved(network, seed=1):
    """Return the same network with heads that are no longer zero."""
    torch.manual_seed(seed)
    for head in (network.maps, network.by_normal, network.grid):
        torch.nn.init.normal_(head.weight, std=0.05)
    return network.eval()


def test_an_untrained_network_gives_the_prior_back_whatever_its_size():
    for h, w in ((45, 70), (17, 400), (300, 33)):
        view = example(h, w)
        made = Compact(CompactNetwork(TINY), device=torch.device("cpu")).harmonize(view)
        assert made.image.shape == (h, w, 3)
        assert made.confidence is not None
        assert made.confidence.shape == (h, w)
        # exp(log(a / b)) * b in float32, and the way to sRGB and back: far less than half a level of 8 bits
        assert (made.image - view.prior).abs().max() < 2e-4


def test_without_an_object_the_prior_is_kept_to_the_bit():
    view = replace(example(), mask=torch.zeros(45, 70))
    made = Compact(moved(CompactNetwork(TINY)), device=torch.device("cpu")).harmonize(view)
    assert torch.equal(made.image, view.prior)


def test_texture_off_the_object_is_multiplied_and_never_made_up():
    view = compact_input(example())
    output = moved(CompactNetwork(TINY))(view.resized(48, 64).channels())
    plain = replace(output, scene_added=torch.zeros_like(output.scene_added))
    lit = apply_output(view, plain)
    # light is never below zero
    off = (view.mask == 0).expand(-1, 3, -1, -1) & (lit > 0)
    brighter = apply_output(replace(view, composite=2 * view.composite + 0.004), plain)
    # (2c + e) + e = 2 (c + e): the factor is independent of the pixel's own light
    torch.testing.assert_close((brighter + 0.004)[off], (2 * (lit + 0.004))[off], rtol=1e-4, atol=1e-5)


def test_strength_goes_from_the_prior_to_the_answer():
    view, network = example(), moved(CompactNetwork(TINY))
    whole = Compact(network, device=torch.device("cpu")).harmonize(view).image
    half = Compact(network, device=torch.device("cpu"), strength=0.5).harmonize(view).image
    assert (whole - view.prior).abs().max() > 0.01
    torch.testing.assert_close(half, 0.5 * (whole + view.prior))
    assert torch.equal(Compact(network, device=torch.device("cpu"), strength=0.0).harmonize(view).image, view.prior)


def test_normals_are_turned_into_the_cameras_frame():
    view = example()
    angle = torch.tensor(0.7)
    turn = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1.0]])
    in_camera = replace(view, normal=view.normal @ turn.T)
    torch.testing.assert_close(
        compact_input(replace(view, camera_from_world=turn)).normal, compact_input(in_camera).normal
    )


def test_weights_are_kept_as_halves_and_read_back(tmp_path):
    network = moved(CompactNetwork(TINY))
    path = tmp_path / "compact.safetensors"
    write_weights(path, network.size, network.state_dict(), {"steps": "0"})
    channels = compact_input(example()).resized(48, 64).channels()
    first, again = network(channels), read_weights(path)(channels)
    # float16 keeps 11 bits of every weight
    torch.testing.assert_close(again.scene_gain, first.scene_gain, rtol=0.02, atol=2e-3)
    named = make_harmonizer(CompactOptions(weights=str(tmp_path)))
    assert named.harmonize(example()).image.shape == (45, 70, 3)


def test_other_weights_are_refused_in_a_line(tmp_path):
    from safetensors.torch import save_file

    path = tmp_path / "compact.safetensors"
    for write, wanted in (
        (lambda: path.unlink(missing_ok=True), "expected weights of the compact harmoniser"),
        (lambda: path.write_bytes(b"no"), "expected weights of the compact harmoniser"),
        (lambda: save_file({"a": torch.zeros(1)}, path), "in its header"),
        (lambda: write_weights(path, TINY, {"a": torch.zeros(1)}, {}), "expected the tensors"),
    ):
        write()
        with pytest.raises(ValueError, match=wanted) as failure:
            make_harmonizer(CompactOptions(weights=str(path)))
        assert str(path) in str(failure.value)


def test_linear_light_is_what_is_multiplied():
    view = example()
    batch = compact_input(view)
    torch.testing.assert_close(batch.composite[0].permute(1, 2, 0), linear_from_srgb(view.composite))
    torch.testing.assert_close(srgb_from_linear(batch.prior()[0]).permute(1, 2, 0), view.prior, atol=2e-4, rtol=0)
