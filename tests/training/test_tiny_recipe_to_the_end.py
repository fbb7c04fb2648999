"""The whole road of the paper's image model at toy size: pairs, base, training by a recipe, inference on unseen scenes.

The recipe `tiny` at a quarter of its pixels, with a base model of 1.1 million weights whose autoencoder halves pictures
once instead of twice: about four minutes of one core instead of forty.
"""

import pytest
import torch

pytest.importorskip("diffusers")

from tiny_models import quiet

from splatgraft.cli import main
from splatgraft.core.image_metrics import psnr
from splatgraft.harmonization import make_harmonizer
from splatgraft.harmonization.interface import HarmonizerInputs
from splatgraft.harmonization.options import FluxOptions, HarmonizerContext
from splatgraft_paper.training.sources.relit_pairs import RelitPairs
from splatgraft_paper.training.tiny_base import TinyBaseOptions, write_tiny_base

pytestmark = [*quiet, pytest.mark.long, pytest.mark.filterwarnings("ignore::UserWarning")]

BASE = TinyBaseOptions(heads=3, double_blocks=1, single_blocks=2, autoencoder_widths=(32, 32), autoencoder_steps=3000)
LOOP = ["--size", "32x32", "--steps", "2000", "--rate", "2e-3", "--ema", "0.99", "--validate-every", "1000"]


def silent(*words):
    pass


def pairs(folder, scenes, seed):
    words = ["--scenes", str(scenes), "--size", "32x32", "--seed", str(seed)]
    assert main(["synth", "spheres", str(folder), *words]) == 0
    return RelitPairs(folder)


def test_the_trained_harmoniser_brings_unseen_scenes_nearer_to_the_truth(tmp_path):
    training = pairs(tmp_path / "pairs", 300, 0)
    pictures = []
    for index in range(0, len(training), 3):
        pair = training.read(index)
        pictures += [pair.picture(role).permute(2, 0, 1) for role in ("target", "composite", "mask")]
    write_tiny_base(tmp_path / "base", pictures, BASE, say=silent, progress=silent)
    words = ["--recipe", "tiny", "--base", str(tmp_path / "base"), "--generated", str(tmp_path / "pairs"), *LOOP]
    assert main(["train", "flux", str(tmp_path / "out"), *words]) == 0

    options = FluxOptions(weights=str(tmp_path / "out" / "model"), precision="float32")
    harmonizer = make_harmonizer(options, HarmonizerContext())
    unseen, gains = pairs(tmp_path / "unseen", 16, 1), []
    for index in range(0, len(unseen), 3):
        pair = unseen.read(index)
        flat = torch.zeros(*pair.mask.shape, 3)
        view = HarmonizerInputs(pair.composite, pair.background, pair.mask, flat[..., 0], flat, pair.composite)
        result = harmonizer.harmonize(view).image
        # what differs between composite and truth is the object's light and its shadow
        wrong = (pair.composite - pair.target).abs().amax(-1) > 0.05
        regions = (None, pair.mask > 0.5, wrong)
        gains.append(
            [float(psnr(result, pair.target, part) - psnr(pair.composite, pair.target, part)) for part in regions]
        )
    whole, inside, wrong = torch.tensor(gains).mean(0).tolist()
    print(f"gain: whole picture {whole:.2f} dB, object {inside:.2f} dB, where the composite is wrong {wrong:.2f} dB")
    # the run that this was written with: +2.1, +1.7 and +5.5 dB (the recipe itself +4.1, +2.4 and +7.9); an untrained
    # model is worse than its input, and one that copies it gains nothing
    assert whole > 1
    assert inside > 0.3
    assert wrong > 3
