"""placement.json: exact round trip, the accepted forms, and one clear line for everything else."""

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.project.placement import ObjectPlacement, Placement, read_placement, write_placement


def test_round_trip_is_bit_exact(tmp_path):
    erased = torch.arange(11) % 2 == 0
    rotation = rotation_from_quaternion(torch.tensor([[0.3, -0.5, 0.7, 0.1]]))[0]
    moved = Similarity(scale=0.7531, rotation=rotation, translation=torch.tensor([0.1, -2.3, 1 / 3]))
    objects = (ObjectPlacement(moved, tmp_path / "objects" / "vase.ply"), ObjectPlacement(Similarity.identity()))
    write_placement(tmp_path / "placement.json", Placement(objects=objects, erased=erased))
    read = read_placement(tmp_path / "placement.json")
    assert [o.object_path for o in read.objects] == [tmp_path / "objects" / "vase.ply", None]
    for before, after in zip(objects, read.objects, strict=True):
        assert after.target_from_object.scale == before.target_from_object.scale
        assert torch.equal(after.target_from_object.rotation, before.target_from_object.rotation)
        assert torch.equal(after.target_from_object.translation, before.target_from_object.translation)
    assert read.objects[1].target_from_object.is_identity
    assert read.erased is not None
    assert torch.equal(read.erased, erased)


def test_quaternion_form_and_defaults(tmp_path):
    path = tmp_path / "placement.json"
    half = 0.5**0.5
    path.write_text(json.dumps({"objects": [{"rotation": [half, 0, 0, half], "translation": [1, 2, 3]}, {}]}))
    turned, plain = (o.target_from_object for o in read_placement(path).objects)
    expected = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert torch.allclose(turned.rotation, expected, atol=1e-6)  # float32 of a rotation computed in float64
    assert plain.is_identity


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "expected JSON"),
        ("[]", 'list "objects"'),
        ('{"objects": 3}', 'list "objects"'),
        ('{"objects": [], "surprise": 1}', "found also"),
        ('{"objects": [{"scale": 0}]}', r"objects\[0\]: expected a scale above 0"),
        ('{"objects": [{"scale": "big"}]}', "a finite number for 'scale'"),
        ('{"objects": [{"scale": true}]}', "a finite number for 'scale'"),
        ('{"objects": [{"scale": NaN}]}', "a finite number for 'scale'"),
        ('{"objects": [{"translation": [1, 2, NaN]}]}', "a finite translation"),
        ('{"objects": [{"rotation": [1, 0, 0, Infinity]}]}', "a finite quaternion"),
        ('{"objects": [{"rotation": [0, 0, 0, 0]}]}', "other than zero"),
        ('{"objects": [{"rotation": [1, 0, 0]}]}', "numbers of shape"),
        ('{"objects": [{"rotation": [[1, 0], [0, 1]]}]}', "numbers of shape"),
        ('{"objects": [{"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}]}', "determinant 1"),
        ('{"objects": [{"rotation": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]}]}', "orthonormal"),
        ('{"objects": [{"translation": [1, 2]}]}', "numbers of shape"),
        ('{"objects": [{"turn": 3}]}', "an object with only"),
        ('{"objects": [{"object": 3}]}', "a file name"),
        ('{"objects": [], "erased": 3}', "a file name"),
        ('{"objects": [], "erased": "none.npy"}', "found no file"),
    ],
)
def test_what_is_wrong_is_said_in_one_line_that_names_the_file(tmp_path, content, message):
    path = tmp_path / "placement.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_placement(path)
    assert str(caught.value).startswith(str(tmp_path))
    assert "\n" not in str(caught.value)


def test_erased_of_another_kind_and_missing_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="expected a JSON file, found none"):
        read_placement(tmp_path / "placement.json")
    (tmp_path / "placement.json").write_text('{"objects": [], "erased": "erased.npy"}')
    for array in (np.zeros(3), np.zeros((2, 2), bool), np.array([None, 1], dtype=object)):
        np.save(tmp_path / "erased.npy", array, allow_pickle=True)
        with pytest.raises(ValueError, match=r"erased.npy: expected a"):
            read_placement(tmp_path / "placement.json")


KEYS = st.sampled_from(["objects", "erased", "scale", "rotation", "translation", "object"])
SIMPLE = st.none() | st.booleans() | st.floats() | st.text()


@settings(max_examples=50, deadline=None)
@given(st.recursive(SIMPLE, lambda x: st.lists(x) | st.dictionaries(KEYS, x)))
def test_any_json_is_read_or_refused_with_a_line(tmp_path_factory, content):
    path = Path(tmp_path_factory.getbasetemp()) / "fuzz.json"
    path.write_text(json.dumps(content))
    with contextlib.suppress(ValueError):  # any other exception fails
        read_placement(path)
