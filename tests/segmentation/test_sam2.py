"""SAM 2: the recorded interface of its public ONNX exports, on tiny networks. The real weights were not run.

The interface (names, order, shapes, dynamic axes) is that of samexporter's export_sam2.py, at a side of 64 for 1024.
"""

import pytest
import torch

from splatgraft.core.prompts import ViewPrompt
from splatgraft.segmentation import Evidence, load_sam2

SIDE = 64


@pytest.fixture
def tiny(tmp_path):
    """Networks whose three proposals are: the box, the surroundings of the box, nothing; the first is the best."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    helper, float_ = onnx.helper, onnx.TensorProto.FLOAT

    def info(name, shape):
        return helper.make_tensor_value_info(name, float_, shape)

    def save(name, nodes, inputs, outputs, weights=()):
        graph = helper.make_graph(nodes, name, inputs, outputs, list(weights))
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        onnx.checker.check_model(model)
        onnx.save(model, tmp_path / name)
        return tmp_path / name

    def constant(name, shape, values, kind=float_):
        return helper.make_tensor(name, kind, shape, values)

    features = {"high_res_feats_0": 16, "high_res_feats_1": 8, "image_embed": 4}

    def make(skip="", extra=()):
        encoder_nodes = [
            helper.make_node(
                "AveragePool", ["image"], [name], kernel_shape=[SIDE // side] * 2, strides=[SIDE // side] * 2
            )
            for name, side in features.items()
        ]
        encoder = save(
            "encoder.onnx",
            encoder_nodes,
            [info("image", [1, 3, SIDE, SIDE])],
            [info(name, [1, 3, side, side]) for name, side in features.items() if name != skip],
        )
        # a pixel is in the box where (x - left) (right - x) > 0, and the same for y; corners have the labels 2 and 3
        decoder_nodes = [
            helper.make_node("Unsqueeze", ["point_labels", "two"], ["labels"]),
            helper.make_node("Equal", ["labels", "label_2"], ["is_first"]),
            helper.make_node("Equal", ["labels", "label_3"], ["is_last"]),
            helper.make_node("Cast", ["is_first"], ["first"], to=float_),
            helper.make_node("Cast", ["is_last"], ["last"], to=float_),
            helper.make_node("Mul", ["point_coords", "first"], ["first_points"]),
            helper.make_node("Mul", ["point_coords", "last"], ["last_points"]),
            helper.make_node("ReduceSum", ["first_points", "one"], ["from"], keepdims=0),
            helper.make_node("ReduceSum", ["last_points", "one"], ["to"], keepdims=0),
            helper.make_node("Sub", ["pixels", "from"], ["after"]),
            helper.make_node("Sub", ["to", "pixels"], ["before"]),
            helper.make_node("Min", ["after", "before"], ["within"]),
            helper.make_node("ReduceMin", ["within"], ["inside"], axes=[3], keepdims=0),
            helper.make_node("Unsqueeze", ["inside", "one_axis"], ["mask"]),
            helper.make_node("Neg", ["mask"], ["outside"]),
            helper.make_node("Mul", ["mask", "zero"], ["nothing"]),
            helper.make_node("Concat", ["mask", "outside", "nothing"], ["masks"], axis=1),
            helper.make_node("Identity", ["scores"], ["iou_predictions"]),
        ]
        small = SIDE // 4
        centres = [(4 * i + 2, 4 * j + 2) for j in range(small) for i in range(small)]
        pixels = [float(x) for pair in centres for x in pair]
        int64 = onnx.TensorProto.INT64
        weights = [
            constant("two", [1], [2], int64),
            constant("one", [1], [1], int64),
            constant("one_axis", [1], [1], int64),
            constant("label_2", [], [2.0]),
            constant("label_3", [], [3.0]),
            constant("zero", [], [0.0]),
            constant("pixels", [1, small, small, 2], pixels),
            constant("scores", [1, 3], [0.9, 0.5, 0.1]),
        ]
        inputs = [info(name, [1, 3, features[name], features[name]]) for name in sorted(features, reverse=True)]
        inputs += [
            info("point_coords", ["num_labels", "num_points", 2]),
            info("point_labels", ["num_labels", "num_points"]),
            info("mask_input", ["num_labels", 1, small, small]),
            info("has_mask_input", ["num_labels"]),
            *(info(name, [2]) for name in extra),
        ]
        outputs = [info("masks", [1, 3, small, small]), info("iou_predictions", [1, 3])]
        return encoder, save("decoder.onnx", decoder_nodes, inputs, outputs, weights)

    return make


def test_the_best_proposal_for_the_box_of_the_selection_is_taken(tiny):
    network = load_sam2(*tiny())
    assert network.side == SIDE
    lifted = torch.zeros(96, 128)
    lifted[24:48, 32:96] = 1
    mask = network.cut(torch.rand(96, 128, 3, generator=torch.Generator().manual_seed(0)), Evidence(lifted))
    assert mask.shape == (96, 128)
    rows, columns = torch.nonzero(mask, as_tuple=True)
    # the margin of 5% of the box, and half a pixel of the 16 x 16 proposal, which is 6 x 8 pixels of the picture
    assert abs(int(rows.min()) - 24) <= 6
    assert abs(int(rows.max()) - 47) <= 6
    assert abs(int(columns.min()) - 32) <= 9
    assert abs(int(columns.max()) - 95) <= 9
    assert set(mask.unique().tolist()) == {0.0, 1.0}


def test_a_rectangle_of_the_user_comes_first_and_decoders_may_ask_for_the_size(tiny):
    network = load_sam2(*tiny(extra=("orig_im_size",)))
    lifted = torch.zeros(64, 64)
    lifted[40:60, 40:60] = 1
    prompt = ViewPrompt(inside=torch.tensor([[12.0, 12.0]]), box=(0.0, 0.0, 32.0, 32.0))
    mask = network.cut(torch.zeros(64, 64, 3), Evidence(lifted, prompt))
    assert mask[16, 16] == 1
    assert mask[50, 50] == 0


def test_networks_of_another_kind_are_named(tiny, tmp_path):
    encoder, decoder = tiny()
    with pytest.raises(ValueError, match=r"decoder\.onnx: expected the outputs image_embed, high_res_feats_0"):
        load_sam2(decoder, decoder)
    with pytest.raises(ValueError, match=r"encoder\.onnx: expected the inputs image_embed, high_res_feats_0"):
        load_sam2(encoder, encoder)
    with pytest.raises(ValueError, match=r"none\.onnx: expected an \.onnx file, found none"):
        load_sam2(tmp_path / "none.onnx", decoder)
    with pytest.raises(ValueError, match=r"encoder\.onnx: expected the outputs image_embed, high_res_feats_0"):
        load_sam2(*tiny(skip="image_embed"))
    with pytest.raises(ValueError, match=r"found also dictionary"):
        load_sam2(*tiny(extra=("dictionary",)))
