"""What validation measured is what is saved: every tensor of the folder is compared after it was read by diffusers."""

from dataclasses import replace

import pytest
import torch

pytest.importorskip("diffusers")

from tiny_models import quiet, removal_folder
from tiny_pairs import rendered_folder
from tiny_training import QUICK, measuring, silent, training

from splatgraft_paper.training import trainer
from splatgraft_paper.training.latent_cache import LatentCache
from splatgraft_paper.training.removal_objective import RemovalObjective
from splatgraft_paper.training.sources.pair_source import split_mixture
from splatgraft_paper.training.sources.rendered_pairs import RenderedPairs
from splatgraft_paper.training.trainer import TrainingRun, train

pytestmark = [*quiet, pytest.mark.filterwarnings("ignore::UserWarning")]
AVERAGED = replace(QUICK, ema=0.9, steps=4, validate_every=4)


@pytest.fixture
def measured():
    weights: dict = {}
    plain = measuring(weights)
    yield weights
    trainer.validate = plain


def assert_same(folder, model, measured, trained):
    read = model.from_pretrained(folder).state_dict()
    assert set(read) == set(measured)
    assert all(torch.equal(read[name], measured[name]) for name in read)
    # the last weights are others than their average
    assert sum(not torch.equal(read[name], trained[name]) for name in read) > len(read) / 2


def test_the_average_of_the_transformer_is_saved(tmp_path, measured):
    from diffusers import FluxTransformer2DModel

    run = training(tmp_path, "out", AVERAGED)
    folder = train(run)
    assert_same(folder / "transformer", FluxTransformer2DModel, measured, run.objective.network.state_dict())


def test_the_average_of_the_object_removal_is_saved(tmp_path, measured):
    from diffusers import UNet2DConditionModel

    source = RenderedPairs(rendered_folder(tmp_path / "pairs", 1))
    objective = RemovalObjective(str(removal_folder(tmp_path / "base")), silent, checkpointing=False)
    mixture, _ = split_mixture([source], weights=(), held_out=0.0, seed=0)
    cache = LatentCache(tmp_path / "latents", objective.encode, width=32, height=32, autoencoder="tiny")
    run = TrainingRun(objective, mixture, None, cache, AVERAGED, tmp_path / "out", silent, silent)
    folder = train(run)
    assert_same(folder / "unet", UNet2DConditionModel, measured, objective.network.state_dict())
