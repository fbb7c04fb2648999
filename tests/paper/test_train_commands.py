"""The commands `train` and `synth generated` on tiny models; several processes train as one."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("diffusers")

from test_training_pairs import environment
from tiny_models import flux_folder, quiet, removal_folder
from tiny_pairs import relit_folder, rendered_folder, shipped_samples

from splatgraft.cli import main
from splatgraft_paper.training.pairs import open_relit

pytestmark = [*quiet, pytest.mark.filterwarnings("ignore::UserWarning")]
SMALL = ["--size", "32x32", "--batch", "2", "--precision", "no", "--cpu", "--steps", "3", "--validation-pairs", "1"]


def words(tmp_path, out, *more):
    if not (tmp_path / "base").is_dir():
        flux_folder(tmp_path / "base")
        rendered_folder(tmp_path / "rendered")
        relit_folder(tmp_path / "relit", 2)
    data = ["--pairs", str(tmp_path / "rendered"), "--generated", str(tmp_path / "relit"), "--weights", "2", "1"]
    return ["paper", "train", "flux", str(tmp_path / out), "--base", str(tmp_path / "base"), *data, *SMALL, *more]


def test_pairs_become_a_harmonizer_s_folder(tmp_path, capsys):
    assert main(words(tmp_path, "out")) == 0
    printed = capsys.readouterr()
    assert printed.out.strip() == str(tmp_path / "out" / "model")
    assert "1 pairs to train on, 1 held out" in printed.err
    names = {path.name for path in (tmp_path / "out" / "model").iterdir()}
    assert names == {"transformer", "vae", "empty_prompt.safetensors", "harmonizer.json", "split.json"}
    # training can continue from a harmoniser's folder
    again = ["paper", "train", "flux", str(tmp_path / "again"), "--base", str(tmp_path / "out" / "model")]
    assert main([*again, "--generated", str(tmp_path / "relit"), *SMALL]) == 0


def test_bad_words_are_one_line(tmp_path, capsys):
    for change, line in (
        (["--size", "33x32"], "--size: expected WIDTHxHEIGHT in multiples of 16, found 33x32"),
        (["--pairs", str(tmp_path)], f"{tmp_path}/manifest.jsonl: expected the manifest of rendered pairs, found none"),
        (
            ["--base", str(tmp_path / "rendered")],
            "rendered/config.json: expected the config of a FluxTransformer2DModel",
        ),
    ):
        assert main(words(tmp_path, "out", *change)) == 2
        assert line in capsys.readouterr().err.strip().splitlines()[-1]
    assert not (tmp_path / "out" / "states").exists()


def test_generated_images_become_pairs(tmp_path, monkeypatch, capsys):
    samples = [sample for _, sample in shipped_samples(3)]

    class Pipeline:
        asked: list = []  # noqa: RUF012

        def to(self, where):
            return self

        def __call__(self, prompt, **settings):
            self.asked.append((prompt, settings["num_inference_steps"], settings["guidance_scale"]))
            picture = samples[len(self.asked) % 3].target.numpy()
            made = Image.fromarray((picture * 255).astype(np.uint8))
            return type("Made", (), {"images": [made]})

    class Masks:
        def mask(self, image):
            return torch.nn.functional.pad(torch.ones(16, 16), (8, 8, 8, 8))

    monkeypatch.setattr(
        "splatgraft_paper.training.generate.text_to_image_pipeline",
        lambda base, **settings: Pipeline(),
    )
    monkeypatch.setattr("splatgraft.segmentation.onnx_networks.load_birefnet", lambda weights: Masks())
    base = removal_folder(tmp_path / "base")
    trained = ["paper", "train", "removal", str(tmp_path / "removal"), "--base", str(base), "--pairs"]
    assert main([*trained, str(rendered_folder(tmp_path / "rendered")), *SMALL, "--steps", "1"]) == 0
    environment(tmp_path / "maps", "left", "left")
    asked = ["paper", "synth", "generated", str(tmp_path / "out"), "--removal", str(tmp_path / "removal" / "model")]
    asked += ["--lights", str(tmp_path / "maps"), "--number", "2", "--size", "32x32", "--device", "cpu"]
    assert main(asked) == 2
    assert "--renderer: expected the folder of DiffusionRenderer's code" in capsys.readouterr().err
    assert main([*asked, "--relighter", "stand-in"]) == 0
    assert main([*asked, "--relighter", "stand-in"]) == 0
    assert len(Pipeline.asked) == 2
    assert {asked[1:] for asked in Pipeline.asked} == {(4, 1.0)}
    assert len(open_relit(tmp_path / "out").pairs) == 2
    line = json.loads((tmp_path / "out" / "manifest.jsonl").read_text().splitlines()[0])
    assert "stand-in" in line["relighter"]
    assert line["prompt"] == Pipeline.asked[0][0]
