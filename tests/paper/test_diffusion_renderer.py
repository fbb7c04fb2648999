"""DiffusionRenderer: the real parsers' option tables accept every command line, and models are loaded once."""

import argparse
import json
import stat
import sys
from pathlib import Path

import pytest
import torch
import yaml

from splatgraft_paper.training.relighters import DiffusionRenderer, forward_arguments, inverse_arguments

TABLES = json.loads((Path(__file__).parent / "diffusion_renderer_options.json").read_text())
INVERSE, FORWARD = Path("/data/in"), Path("/data/buffers")
MAPS = [Path("/maps/a map.hdr"), Path("/maps/it's.hdr"), Path("/maps/c.hdr")]


def merged(defaults, dotlist):
    """Merge a dotlist into a configuration like OmegaConf, which reads values as YAML."""
    given = dict(word.split("=", 1) for word in dotlist)
    assert set(given) <= set(defaults), f"no such key: {set(given) - set(defaults)}"
    return defaults | {key: yaml.safe_load(value) for key, value in given.items()}


def test_the_programs_take_our_command_lines():
    parser = argparse.ArgumentParser(exit_on_error=False)
    parser.add_argument("--config", type=str, required=True)
    known, rest = parser.parse_known_args(inverse_arguments(INVERSE, FORWARD, (448, 704)))
    assert known.config == "configs/rgbx_inference.yaml"
    config = merged(TABLES["svd"]["inverse"], rest)
    # split_list_with_overlap: "Overlap size must be less than the chunk size."
    assert config["overlap_n_frames"] < config["inference_n_frames"] == 1
    assert config["save_image"]
    assert not config["save_video"]
    assert config["inference_res"] == [448, 704]
    assert config["model_passes"] == ["basecolor", "metallic", "roughness", "normal", "depth"]
    known, rest = parser.parse_known_args(forward_arguments(FORWARD, INVERSE, MAPS, (448, 704)))
    assert known.config == "configs/xrgb_inference.yaml"
    config = merged(TABLES["svd"]["forward"], rest)
    assert config["envlight"] == [str(path) for path in MAPS]
    assert config["image_group_mode"] == "webdataset"
    assert config["save_image"]


# Stand-ins of the programs: they read, print, load and write the same as the recorded versions. They darken by the
# number of the light instead of rendering.
_SVD = """
import argparse, json, pathlib, sys
import numpy as np, yaml
from PIL import Image

class RGBXVideoDiffusionPipeline:
    @staticmethod
    def from_pretrained(weights, **named):
        with open("loads.txt", "a") as stream: stream.write("PROGRAM\\n")
        return RGBXVideoDiffusionPipeline()

def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", type=str, required=True)
    args, unknown = parser.parse_known_args()
    defaults = json.loads(pathlib.Path("options.json").read_text())["svd"]["PART"]
    cfg = defaults | {k: yaml.safe_load(v) for k, v in (word.split("=", 1) for word in unknown)}
    assert cfg["save_video"] or cfg["save_image"]
    RGBXVideoDiffusionPipeline.from_pretrained(cfg["inference_model_weights"], cond_mode=cfg["cond_mode"])
    print("processing videos")
    given, out = pathlib.Path(cfg["inference_input_dir"]), pathlib.Path(cfg["inference_save_dir"])
    if "PART" == "inverse":
        if cfg["overlap_n_frames"] >= cfg["inference_n_frames"]:
            raise ValueError("Overlap size must be less than the chunk size.")
        for path in given.rglob("*.png"):
            folder = out / path.parent.relative_to(given)
            folder.mkdir(parents=True, exist_ok=True)
            for name in ("rgb", *cfg["model_passes"]):
                picture = Image.open(path).resize(cfg["inference_res"][::-1])
                picture.save(folder / f"0000.0000.{name}.png")
        return
    assert all(pathlib.Path(light).is_file() for light in cfg["envlight"])
    for path in given.rglob("*.basecolor.png"):
        base = out / path.relative_to(given).parent / path.name.split(".")[0]
        base.parent.mkdir(parents=True, exist_ok=True)
        for number, _ in enumerate(cfg["envlight"]):
            picture = np.asarray(Image.open(path)) // (number + 1)
            Image.fromarray(picture).save(f"{base}.0000.env{number:04d}.png")

if __name__ == "__main__":
    main()
"""


@pytest.fixture
def python(tmp_path):
    """Write a program that starts quickly, because "import torch" does not load torch."""
    path = tmp_path / "python"
    path.write_text(f'#!/bin/sh\n[ "$1" = -c ] && exit 0\nexec {sys.executable} "$@"\n')
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def installation(folder, how=lambda text: text):
    folder.mkdir()
    (folder / "options.json").write_text(json.dumps(TABLES))
    for part, name in {"inverse": "inference_svd_rgbx.py", "forward": "inference_svd_xrgb.py"}.items():
        (folder / name).write_text(how(_SVD.replace("PART", part).replace("PROGRAM", part)))
    return folder


def drafts(count):
    """Write smooth pictures with a mask each."""
    g = torch.Generator().manual_seed(0)
    return [(torch.rand(1, 1, 3, generator=g).expand(48, 80, 3), torch.ones(48, 80)) for _ in range(count)]


def maps(folder, count):
    folder.mkdir()
    paths = [folder / f"map {i}.hdr" for i in range(count)]
    for path in paths:
        path.write_bytes(b"#?RADIANCE")
    return paths


def test_many_pictures_and_lights_load_each_model_once(tmp_path, python):
    folder = installation(tmp_path / "code")
    renderer, lights = DiffusionRenderer(folder, python), maps(tmp_path / "maps", 3)
    for draft in drafts(3):
        relit = renderer.relight(*draft, lights)
        assert [picture.shape for picture in relit] == [(48, 80, 3)] * 3
        for number, picture in enumerate(relit):
            # 8 bits
            assert (picture - draft[0] / (number + 1)).abs().max() < 0.02
    assert sorted((folder / "loads.txt").read_text().split()) == ["forward", "inverse"]
    renderer.close()


def test_a_picture_that_the_models_cannot_take_is_padded_and_not_stretched(tmp_path, python):
    renderer, lights = DiffusionRenderer(installation(tmp_path / "code"), python), maps(tmp_path / "maps", 1)
    # 50 rows; stretching them to 64 would mix neighbours
    stripes = (torch.arange(50) % 2).float()[:, None, None].expand(50, 70, 3).contiguous()
    (relit,) = renderer.relight(stripes, torch.ones(50, 70), lights)
    assert torch.equal(relit, stripes)
    renderer.close()


FAILURES = {
    "raises": (
        "raise RuntimeError('CUDA out of memory\\n in a kernel')",
        r"inference_svd_rgbx.py: expected it to succeed, found RuntimeError: CUDA out of memory in a kernel",
    ),
    "dies": (
        "print('Killed', file=sys.stderr, flush=True); os._exit(9)",
        r"expected it to succeed, found its process ended \(Killed\)",
    ),
}


@pytest.mark.parametrize("how", FAILURES)
def test_a_program_that_fails_is_one_line_and_the_next_picture_is_made(tmp_path, python, how):
    failure, line = FAILURES[how]
    once = "def main():\n    import os\n    if not os.path.exists('failed'):\n        open('failed', 'w').close()\n"
    once += f"        {failure}\n"
    folder = installation(tmp_path / "code", lambda text: text.replace("def main():\n", once))
    renderer, lights = DiffusionRenderer(folder, python), maps(tmp_path / "maps", 1)
    with pytest.raises(ValueError, match=line) as error:
        renderer.relight(*drafts(1)[0], lights)
    assert "\n" not in str(error.value)
    assert len(renderer.relight(*drafts(1)[0], lights)) == 1
    renderer.close()


def test_an_installation_that_is_none_is_one_line(tmp_path, python):
    with pytest.raises(ValueError, match=r"expected an installation of DiffusionRenderer with inference_svd_rgbx\.py"):
        DiffusionRenderer(tmp_path, python)
    with pytest.raises(ValueError, match="expected a Python that runs DiffusionRenderer"):
        DiffusionRenderer(installation(tmp_path / "code"), tmp_path / "nowhere")
