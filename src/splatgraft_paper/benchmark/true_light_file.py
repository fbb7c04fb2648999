"""The true light of a benchmark scene as a light.json, from its rendered panorama and its suns."""

import json
from pathlib import Path

import numpy as np
import torch

from splatgraft.relighting.light.light import Light, light_from_json, light_to_json
from splatgraft_paper.benchmark.true_light import light_from_probe

TRUE_LIGHT_FILE = "true_light.json"


def write_true_light(scene: Path) -> None:
    """Write true_light.json from probe.npy and suns.json of a gathered scene.

    Raises:
        ValueError: One of the two is missing or damaged.
    """
    try:
        panorama = torch.from_numpy(np.load(scene / "probe.npy", allow_pickle=False))
        suns = json.loads((scene / "suns.json").read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{scene}: expected probe.npy and suns.json, found {error}") from error
    (scene / TRUE_LIGHT_FILE).write_text(light_to_json(light_from_probe(panorama, suns)))


def read_true_light(path: Path) -> Light:
    """Read true_light.json.

    Raises:
        ValueError: There is no such file.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected the scene's true light, found none")
    return light_from_json(path.read_text(), name=str(path))
