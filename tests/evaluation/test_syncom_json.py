"""SynCom's cameras.json and transform.json: axes, masks, placements, and what is refused."""

import json
import math

import pytest
import torch
from paper_data import TERRACE, put
from syncom_data import SCENE_FROM_OBJECT, write_cameras_json, write_syncom

from splatgraft.formats import read_cameras
from splatgraft_paper.tables import syncom_json


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder as the card says."""
    return write_syncom(tmp_path_factory.mktemp("syncom"), object_views=4)


def test_cameras_are_those_of_the_same_capture_in_our_format(data):
    wanted = read_cameras(TERRACE / "target")[list(range(18))]
    found = syncom_json.read_cameras(data / "scene/patio/train")
    assert torch.allclose(found.world_from_camera, wanted.world_from_camera, atol=1e-6)
    assert torch.allclose(found.intrinsics, wanted.intrinsics)
    assert [f"{name}.png" for name in found.names] == list(wanted.names)
    capture = syncom_json.read_capture(data / "scene/patio/train")
    assert len(capture) == 18
    assert not capture.mask_paths


def test_an_objects_alpha_is_its_mask_and_its_linear_pictures_are_left_alone(data):
    capture = syncom_json.read_capture(data / "object/pot/train")
    assert [path.suffix for path in capture.image_paths] == [".png"] * 4
    assert 0.01 < float(capture.mask(0).mean()) < 0.6


def test_the_objects_cameras_placed_in_the_scene_are_where_they_were(data):
    move = syncom_json.read_transform(data / "composition/patio_with_pot/transform.json", "pot")
    assert move.scale == pytest.approx(SCENE_FROM_OBJECT.scale)
    centers = move.points(syncom_json.read_cameras(data / "object/pot/train").centers)
    # float32 sums of numbers up to 10
    assert torch.allclose(centers, read_cameras(TERRACE / "source").centers[:4], atol=1e-5)


def test_a_placement_by_angles_is_the_matrix_that_blender_makes_of_them(tmp_path):
    path = tmp_path / "transform.json"
    entry = {"rotation": [math.pi / 2, 0, math.pi / 2], "location": [1, 2, 3], "scale": [2, 2, 2]}
    path.write_text(json.dumps({"toy": entry}))
    # first about x: z to -y, y to z; then about z: x to y, y to -x
    assert torch.allclose(
        syncom_json.read_transform(path, "toy").points(torch.eye(3)),
        torch.tensor([[1.0, 4.0, 3.0], [1.0, 2.0, 5.0], [3.0, 2.0, 3.0]]),
        atol=1e-6,
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "expected a transform of the object 'toy', found none"),
        ({"horse": {}}, "expected a transform of the object 'toy', found horse"),
        ({"toy": {"scale": [1, 1, 2]}}, "expected one scale above 0 for 'toy', found"),
        ({"toy": {"rotation_type": "ZYX"}}, "expected rotation_type 'XYZ', found 'ZYX'"),
        ({"toy": {"transform": [1, 2]}}, "expected numbers of shape"),
    ],
)
def test_a_placement_that_is_no_similarity_is_one_line(tmp_path, content, message):
    path = tmp_path / "transform.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        syncom_json.read_transform(path, "toy")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "expected an object 'cameras' with one entry a view, found None"),
        ({"cameras": {}}, "expected an object 'cameras' with one entry a view"),
        ({"cameras": {"a": 3}}, "expected camera 'a' to be an object, found int"),
        ({"cameras": {"a": {"name": "0", "width": 8, "height": 8, "intr": [8]}}}, "shape .* for 'intr'"),
        ({"cameras": {"a": {"name": "0", "width": 8, "height": 8, "intr": 8}}}, "shape .* for 'intr'"),
    ],
)
def test_broken_cameras_are_one_line(tmp_path, content, message):
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        syncom_json.read_cameras(tmp_path)


def test_a_capture_with_linear_pictures_alone_says_so(tmp_path):
    write_cameras_json(tmp_path, read_cameras(TERRACE / "source")[[0, 1]])
    (tmp_path / "images").mkdir()
    for stem in ("0000", "0001"):
        (tmp_path / "images" / f"{stem}.exr").write_bytes(b"linear")
    with pytest.raises(ValueError, match=r"found none, only the linear \.exr, which is not read"):
        syncom_json.read_capture(tmp_path)
    assert syncom_json.is_syncom_capture(tmp_path)
    put(tmp_path / "images/0000.png", torch.zeros(158, 224, 3))
    assert len(syncom_json.read_capture(tmp_path)) == 1
