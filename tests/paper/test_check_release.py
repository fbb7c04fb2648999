"""`paper check-release`: the pictures of a model are found again, and others are not."""

import json

import pytest
import torch

pytest.importorskip("diffusers")

from paper_data import put
from tiny_models import CHANNELS, flux_folder, quiet
from tiny_pairs import shipped_samples

from splatgraft.cli import main
from splatgraft.core.images import read_rgb
from splatgraft.harmonization import FluxOptions, HarmonizerInputs, make_harmonizer

pytestmark = [*quiet]
SCENE = "truck_in_garden"


def test_pictures_of_the_same_weights_are_nearer_than_composites_and_others_are_not(tmp_path, capsys):
    weights = flux_folder(tmp_path / "image-mask", 12 * CHANNELS)
    harmonizer = make_harmonizer(FluxOptions(weights=str(weights)))
    data = tmp_path / "data"
    below = data / "data_3d/real/insertions" / SCENE
    generator = torch.Generator().manual_seed(0)
    for stem, sample in shipped_samples(5):
        # composites are read from 8 bits, so the model gets the rounded ones
        for name, image in (("composite", sample.target), ("masks", sample.mask[..., None].expand(-1, -1, 3))):
            put(below / name / f"{stem}.png", image)
        composite = read_rgb(below / "composite" / f"{stem}.png")
        nothing = torch.zeros_like(sample.mask)
        made = harmonizer.harmonize(HarmonizerInputs(composite, composite, sample.mask, nothing, composite))
        # the authors' pictures are renders, which differ a little
        put(
            data / "results_3d/real/ours" / SCENE / f"{stem}.png",
            made + 0.02 * torch.randn(made.shape, generator=generator),
        )
        put(tmp_path / "other/results_3d/real/ours" / SCENE / f"{stem}.png", 0.9 * composite)
    words = ["paper", "check-release", "--weights", str(weights), "--views", "3", "--device", "cpu"]
    assert main([*words, "--data", str(data), "--out", str(tmp_path / "a")]) == 0
    (row,) = json.loads((tmp_path / "a/release.json").read_text()).values()
    # noise of 0.02 has 34 dB; clamping and 8 bits change it by tenths
    assert row["object"] == pytest.approx(34, abs=1)
    assert row["object_composite"] < 25
    assert row["change"] > 0.95
    assert len(list((tmp_path / "a/scenes" / SCENE / "images").iterdir())) == 3
    assert "| truck_in_garden | 3" in (tmp_path / "a/release.md").read_text()
    assert read_rgb(tmp_path / "a/sheet.png").shape[1] > 4 * 32
    (tmp_path / "other/data_3d/real/insertions").mkdir(parents=True)
    (tmp_path / "other/data_3d/real/insertions" / SCENE).symlink_to(below)
    assert main([*words, "--data", str(tmp_path / "other"), "--out", str(tmp_path / "b")]) == 1
    assert "further from the authors' pictures than the composites" in " ".join(capsys.readouterr().err.split())
    assert main([*words, "--data", str(data), "--only", "none", "--out", str(tmp_path / "c")]) == 2
    assert "expected scenes with composite/, masks/" in capsys.readouterr().err
