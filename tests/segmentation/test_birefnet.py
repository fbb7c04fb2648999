"""BiRefNet: images are scaled and normalised as in training, the output is a mask, bad weights are named."""

from dataclasses import replace

import pytest
import torch

from splatgraft.segmentation import load_birefnet, onnx_networks


@pytest.fixture
def tiny(tmp_path):
    """A network that answers with the normalised red channel, as logits or as it is."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")

    def make(channels=3, side=32, name="tiny.onnx", head="Identity", batch=1):
        float_ = onnx.TensorProto.FLOAT
        weight = onnx.helper.make_tensor("w", float_, [1, channels, 1, 1], [1.0] + [0.0] * (channels - 1))
        nodes = [
            onnx.helper.make_node("Conv", ["input_image", "w"], ["red"]),
            onnx.helper.make_node(head, ["red"], ["output_image"]),
        ]
        given = onnx.helper.make_tensor_value_info("input_image", float_, [batch, channels, side, side])
        found = onnx.helper.make_tensor_value_info("output_image", float_, [batch, 1, side, side])
        graph = onnx.helper.make_graph(nodes, "tiny", [given], [found], [weight])
        model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 13)], ir_version=8)
        onnx.save(model, tmp_path / name)
        return tmp_path / name

    return make


def test_logits_become_a_mask_of_the_pictures_size(tiny):
    image = torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(0))
    network = load_birefnet(tiny())
    assert network.side == 32
    assert network.mask(image).shape == (20, 30)
    halves = torch.zeros(32, 32, 3)
    halves[16:] = 1
    # ImageNet's red mean and deviation; float32
    expected = ((halves[..., 0] - 0.485) / 0.229).sigmoid()
    assert torch.allclose(network.mask(halves), expected, atol=1e-5)


def test_probabilities_stay_as_they_are(tiny):
    network = load_birefnet(tiny(head="Sigmoid"))
    dark = torch.zeros(16, 16, 3)
    # ImageNet's red mean and deviation; float32
    assert torch.allclose(network.mask(dark), torch.tensor(-0.485 / 0.229).sigmoid(), atol=1e-5)


def test_batches_give_the_masks_of_one_by_one_and_sizes_may_differ(tiny):
    g = torch.Generator().manual_seed(0)
    images = [torch.rand(h, w, 3, generator=g) for h, w in ((20, 30), (16, 16), (40, 9))]
    network = load_birefnet(tiny(batch="batch_size"))
    alone = [network.mask(image) for image in images]
    for at_once in (2, 3, 4):
        together = list(replace(network, at_once=at_once).masks(iter(images)))
        assert [mask.shape for mask in together] == [(20, 30), (16, 16), (40, 9)]
        assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(alone, together, strict=True))


def test_all_cores_work_and_cuda_is_taken_where_onnxruntime_has_it(tiny, monkeypatch):
    import onnxruntime

    path = tiny(batch="batch_size")
    network = load_birefnet(path)
    assert network.session.get_session_options().intra_op_num_threads == onnx_networks.usable_cores()
    assert network.place == f"{onnx_networks.usable_cores()} cores"
    assert network.at_once == 1
    asked, there = [], ["CUDAExecutionProvider", "CPUExecutionProvider"]

    class OnCuda:
        def __init__(self, path, options, providers):
            asked.append(providers)

        def get_inputs(self):
            return network.session.get_inputs()

        def get_providers(self):
            return asked[-1]

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: there)
    monkeypatch.setattr(onnxruntime, "InferenceSession", OnCuda)
    found = load_birefnet(path)
    assert asked == [there]
    assert (found.place, found.at_once) == ("CUDA", 4)


def test_bad_weights_are_named(tiny, tmp_path):
    with pytest.raises(ValueError, match=r"none\.onnx: expected an \.onnx file, found none"):
        load_birefnet(tmp_path / "none.onnx")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"not a network")
    with pytest.raises(ValueError, match=r"broken\.onnx: expected an ONNX network"):
        load_birefnet(broken)
    with pytest.raises(ValueError, match=r"expected an input of shape \(1, 3, side, side\), found \[1, 4, 32, 32\]"):
        load_birefnet(tiny(channels=4))


def test_missing_package_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(onnx_networks, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"splatgraft\[birefnet\]"):
        load_birefnet(tmp_path / "any.onnx")
