"""BiRefNet and SAM 2 on tiny networks: images are scaled and normalised as in training, prompts go where they should.

SAM 2's interface (names, order, shapes, dynamic axes) is that of samexporter's export_sam2.py, at a side of 64 for
1024. The real weights were not run.
"""

from types import SimpleNamespace

import pytest
import torch

from splatgraft.core.prompts import ViewPrompt
from splatgraft.segmentation import load_birefnet, load_sam2, onnx_networks

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
FLOAT = onnx.TensorProto.FLOAT
SIDE = 64
FEATURES = {"high_res_feats_0": 16, "high_res_feats_1": 8, "image_embed": 4}
# a pixel is in the box where (x - left) (right - x) > 0, and the same for y; corners have the labels 2 and 3
DECODER = """Unsqueeze point_labels,two labels; Equal labels,label_2 is_first; Equal labels,label_3 is_last
Cast is_first first to=1; Cast is_last last to=1; Mul point_coords,first first_points; Mul point_coords,last last_points
ReduceSum first_points,one from keepdims=0; ReduceSum last_points,one to keepdims=0; Sub pixels,from after
Sub to,pixels before; Min after,before within; ReduceMin within inside axes=[3] keepdims=0; Unsqueeze inside,one mask
Neg mask outside; Mul mask,zero nothing; Concat mask,outside,nothing masks axis=1; Identity scores iou_predictions"""


def info(name, shape):
    return onnx.helper.make_tensor_value_info(name, FLOAT, shape)


def constant(name, shape, values, kind=FLOAT):
    return onnx.helper.make_tensor(name, kind, shape, values)


def node(line):
    kind, inputs, output, *attributes = line.split()
    named = (attribute.split("=") for attribute in attributes)
    return onnx.helper.make_node(kind, inputs.split(","), [output], **{name: eval(value) for name, value in named})


def save(path, nodes, inputs, outputs, weights=()):
    graph = onnx.helper.make_graph(nodes, path.name, inputs, outputs, list(weights))
    onnx.save(onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8), path)
    return path


@pytest.fixture
def red(tmp_path):
    """Write a network that answers with the normalised red channel, as logits or unchanged."""

    def make(channels=3, side=32, head="Identity"):
        weight = constant("w", [1, channels, 1, 1], [1.0] + [0.0] * (channels - 1))
        nodes = [node("Conv input_image,w red"), node(f"{head} red output_image")]
        given, found = (info(f"{end}_image", [1, n, side, side]) for end, n in (("input", channels), ("output", 1)))
        return save(tmp_path / "red.onnx", nodes, [given], [found], [weight])

    return make


@pytest.fixture
def sam2(tmp_path):
    """Write networks with three proposals: the box, the rest of the picture, nothing; the first is the best."""

    def make(skip="", extra=()):
        pools = [
            f"AveragePool image {name} kernel_shape=[{SIDE // side}]*2 strides=[{SIDE // side}]*2"
            for name, side in FEATURES.items()
        ]
        features = [info(name, [1, 3, side, side]) for name, side in FEATURES.items() if name != skip]
        image = info("image", [1, 3, SIDE, SIDE])
        encoder = save(tmp_path / "encoder.onnx", [node(pool) for pool in pools], [image], features)
        small, int64 = SIDE // 4, onnx.TensorProto.INT64
        pixels = [float(x) for j in range(small) for i in range(small) for x in (4 * i + 2, 4 * j + 2)]
        weights = [constant(name, [1], [value], int64) for name, value in (("two", 2), ("one", 1))]
        weights += [constant(name, [], [value]) for name, value in (("label_2", 2.0), ("label_3", 3.0), ("zero", 0.0))]
        weights += [constant("pixels", [1, small, small, 2], pixels), constant("scores", [1, 3], [0.9, 0.5, 0.1])]
        inputs = [info(name, [1, 3, FEATURES[name], FEATURES[name]]) for name in sorted(FEATURES, reverse=True)]
        inputs += [info("point_coords", ["labels", "points", 2]), info("point_labels", ["labels", "points"])]
        inputs += [info("mask_input", ["labels", 1, small, small]), info("has_mask_input", ["labels"])]
        inputs += [info(name, [2]) for name in extra]
        outputs = [info("masks", [1, 3, small, small]), info("iou_predictions", [1, 3])]
        nodes = [node(line.strip()) for line in DECODER.replace("\n", ";").split(";")]
        return encoder, save(tmp_path / "decoder.onnx", nodes, inputs, outputs, weights)

    return make


def test_logits_become_a_mask_of_the_pictures_size_and_probabilities_stay(red):
    network = load_birefnet(red())
    assert network.side == 32
    assert network.mask(torch.rand(20, 30, 3)).shape == (20, 30)
    halves = torch.zeros(32, 32, 3)
    halves[16:] = 1
    # ImageNet's red mean and deviation; float32
    expected = ((halves[..., 0] - 0.485) / 0.229).sigmoid()
    assert torch.allclose(network.mask(halves), expected, atol=1e-5)
    assert torch.allclose(load_birefnet(red(head="Sigmoid")).mask(halves), expected, atol=1e-5)


def test_all_cores_work_and_cuda_is_taken_where_onnxruntime_has_it(red, monkeypatch):
    path = red()
    monkeypatch.setattr(onnx_networks, "_usable_cores", lambda: 3)
    network = load_birefnet(path)
    assert network.session.get_session_options().intra_op_num_threads == 3
    assert network.place == "3 cores"
    asked, there = [], ["CUDAExecutionProvider", "CPUExecutionProvider"]

    def on_cuda(path, options, providers):
        asked.append(providers)
        inputs = network.session.get_inputs()
        return SimpleNamespace(get_inputs=lambda: inputs, get_providers=lambda: providers)

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: there)
    monkeypatch.setattr(onnxruntime, "InferenceSession", on_cuda)
    found = load_birefnet(path)
    assert asked == [there]
    assert found.place == "CUDA"


def test_bad_weights_and_missing_packages_are_named(red, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"none\.onnx: expected an \.onnx file, found none"):
        load_birefnet(tmp_path / "none.onnx")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"not a network")
    with pytest.raises(ValueError, match=r"broken\.onnx: expected an ONNX network"):
        load_birefnet(broken)
    with pytest.raises(ValueError, match=r"expected an input of shape \(1, 3, side, side\), found \[1, 4, 32, 32\]"):
        load_birefnet(red(channels=4))
    monkeypatch.setattr(onnx_networks, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"splatgraft\[birefnet\]"):
        load_birefnet(tmp_path / "any.onnx")


def test_the_best_proposal_for_the_box_of_the_selection_is_taken(sam2):
    network = load_sam2(*sam2())
    assert network.side == SIDE
    lifted = torch.zeros(96, 128)
    lifted[24:48, 32:96] = 1
    mask = network.cut(torch.rand(96, 128, 3), lifted, ViewPrompt())
    assert mask.shape == (96, 128)
    rows, columns = torch.nonzero(mask, as_tuple=True)
    # the margin of 5% of the box, and half a pixel of the 16 x 16 proposal, which is 6 x 8 pixels of the picture
    found = [int(x) for x in (rows.min(), rows.max(), columns.min(), columns.max())]
    assert all(abs(a - b) <= c for a, b, c in zip(found, (24, 47, 32, 95), (6, 6, 9, 9), strict=True))
    assert set(mask.unique().tolist()) == {0.0, 1.0}


def test_a_rectangle_of_the_user_comes_first_and_decoders_may_ask_for_the_size(sam2):
    network = load_sam2(*sam2(extra=("orig_im_size",)))
    lifted = torch.zeros(64, 64)
    lifted[40:60, 40:60] = 1
    prompt = ViewPrompt(inside=torch.tensor([[12.0, 12.0]]), box=(0.0, 0.0, 32.0, 32.0))
    mask = network.cut(torch.zeros(64, 64, 3), lifted, prompt)
    assert mask[16, 16] == 1
    assert mask[50, 50] == 0


def test_networks_of_another_kind_are_named(sam2):
    encoder, decoder = sam2()
    with pytest.raises(ValueError, match=r"decoder\.onnx: expected the outputs image_embed, high_res_feats_0"):
        load_sam2(decoder, decoder)
    with pytest.raises(ValueError, match=r"encoder\.onnx: expected the inputs image_embed, high_res_feats_0"):
        load_sam2(encoder, encoder)
    with pytest.raises(ValueError, match=r"encoder\.onnx: expected the outputs image_embed, high_res_feats_0"):
        load_sam2(*sam2(skip="image_embed"))
    with pytest.raises(ValueError, match=r"found also dictionary"):
        load_sam2(*sam2(extra=("dictionary",)))
