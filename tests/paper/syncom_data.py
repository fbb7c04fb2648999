"""A folder laid out as SynCom's card and the loader of its authors say, made of the shipped benchmark scene."""

import json
import shutil

import numpy as np
import torch
from paper_data import TERRACE, parts_of_view, put
from PIL import Image

from splatgraft.core.similarity import Similarity
from splatgraft.formats import read_cameras

COMPOSITION = "patio_with_pot"
COMPOSED = tuple(f"{index:04d}" for index in range(18, 24))
"""Views of the composition; the others are those of the empty scene's capture."""
_TURN = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SCENE_FROM_OBJECT = Similarity(0.4, _TURN, torch.tensor([0.3, -0.2, 0.1]))
"""The object's capture has another scale, direction and origin than the scene."""
_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])


def write_syncom(root, *, object_views=24):
    """One object, one scene and their composition, with ComGS' pictures: the truth at 0.9."""
    target = read_cameras(TERRACE / "target")
    composed, train = target[list(range(18, 24))], target[list(range(18))]
    composition, scene, pot = (root / name for name in (f"composition/{COMPOSITION}", "scene/patio", "object/pot"))
    write_cameras_json(composition, composed)
    write_cameras_json(scene / "train", train)
    source = read_cameras(TERRACE / "source")[list(range(object_views))]
    write_cameras_json(pot / "train", source, moved=SCENE_FROM_OBJECT.inverse())
    for number, stem in enumerate(COMPOSED):
        truth = parts_of_view(stem)[0]
        put(composition / "images" / f"{stem}.png", truth)
        put(root / "results/ComGS" / COMPOSITION / "frames" / f"{number:05d}.png", truth * 0.9)
    for name in train.names:
        (scene / "train/images").mkdir(parents=True, exist_ok=True)
        shutil.copy(TERRACE / "target/images" / name, scene / "train/images")
    (pot / "train/images").mkdir(parents=True)
    for name in source.names:
        picture = Image.open(TERRACE / "source/images" / name).convert("RGB")
        picture.putalpha(Image.open(TERRACE / "source/masks" / name).convert("L"))
        picture.save(pot / "train/images" / name)
        (pot / "train/images" / name).with_suffix(".exr").write_bytes(b"linear")
    matrix = np.eye(4)
    matrix[:3, :3] = SCENE_FROM_OBJECT.scale * SCENE_FROM_OBJECT.rotation.numpy()
    matrix[:3, 3] = SCENE_FROM_OBJECT.translation.numpy()
    text = json.dumps({"pot": {"transform": matrix.flatten().tolist()}})
    (composition / "transform.json").write_text(text)
    return root


def write_cameras_json(folder, cameras, *, moved=None):
    """SynCom's cameras.json, in the frame that `moved` brings the cameras to."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = {}
    for index, name in enumerate(cameras.names):
        pose = cameras.world_from_camera[index].double()
        if moved is not None:
            pose[:3, 3] = moved.points(pose[:3, 3][None].float())[0].double()
            pose[:3, :3] = moved.rotation.double() @ pose[:3, :3]
        width, height = cameras.sizes[index].tolist()
        focal = [float(cameras.intrinsics[index, 0, 0]), float(cameras.intrinsics[index, 1, 1])]
        entries[f"camera_{index}"] = {
            "name": name.removesuffix(".png"),
            "width": width,
            "height": height,
            "intr": [*focal, width / 2, height / 2],
            "extr": (pose.numpy() @ _BLENDER).flatten().tolist(),
        }
    (folder / "cameras.json").write_text(json.dumps({"cameras": entries}))
