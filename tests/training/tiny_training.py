"""Runs of the training loop on tiny models, also as a program that torchrun starts in several processes.

python tiny_training.py FOLDER '[["NAME", {"loop": {...}, "flux": {...}}], ...]' trains one after the other in
FOLDER/NAME. It writes what each process saw, process_RANK.json, and the weights that validation measured,
measured.safetensors.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from tiny_models import flux_folder
from tiny_pairs import relit_folder

from splatgraft_paper.training.flux_objective import FluxObjective, FluxTraining
from splatgraft_paper.training.latent_cache import LatentCache
from splatgraft_paper.training.loop_options import LoopOptions
from splatgraft_paper.training.sources.pair_source import split_mixture
from splatgraft_paper.training.sources.relit_pairs import RelitPairs
from splatgraft_paper.training.trainer import TrainingRun, train

QUICK = LoopOptions(
    steps=6, batch=2, rate=1e-3, precision="no", save_every=2, validate_every=3, validation_pairs=2, cpu=True
)


def silent(*words):
    pass


def training(tmp_path, name, loop=QUICK, *, pairs=2, progress=silent, say=silent, **flux):
    base, folder = tmp_path / "base", tmp_path / "pairs"
    if not base.is_dir():
        flux_folder(base)
        relit_folder(folder, pairs)
    objective = FluxObjective(FluxTraining(str(base), **flux), say)
    mixture, held_out = split_mixture([RelitPairs(folder)], weights=(), held_out=0.5, seed=loop.seed)
    cache = LatentCache(tmp_path / "latents", objective.encode, width=32, height=32, autoencoder="tiny")
    return TrainingRun(objective, mixture, held_out, cache, loop, tmp_path / name, say, progress)


def measuring(measured):
    """Replaces the loop's validation by one that also keeps the weights that the network had at that time."""
    from splatgraft_paper.training import trainer

    plain = trainer.validate

    def validate(validation, network):
        weights = {}
        for name, value in validation.objective.network.state_dict().items():
            weights[name] = (value.full_tensor() if hasattr(value, "full_tensor") else value).detach().clone()
        measured.clear()
        measured.update(weights)
        return plain(validation, network)

    trainer.validate = validate
    return plain


def main(folder, runs):
    import torch.distributed as dist

    for name, settings in json.loads(runs):
        _run(Path(folder), name, settings)
        if dist.is_initialized():
            dist.barrier()
    if dist.is_initialized():
        dist.destroy_process_group()


def _run(folder, name, given):
    import torch.distributed as dist
    from safetensors.torch import save_file

    from splatgraft_paper.training import trainer

    measured = {}
    plain = measuring(measured)
    loop = replace(QUICK, **given.get("loop", {}))
    run = training(folder / given.get("inside", ""), name, loop, **given.get("flux", {}))
    problem = None
    if given.get("remove"):

        def remove(done, total, message):
            for path in (folder / given["inside"] / "pairs").glob(given["remove"]):
                path.unlink()

        run = replace(run, progress=remove)
    try:
        train(run)
    except ValueError as error:
        problem = str(error)
    trainer.validate = plain
    together = dist.is_initialized()
    rank = dist.get_rank() if together else 0
    seen = {
        "processes": dist.get_world_size() if together else 1,
        "backend": dist.get_backend() if together else None,
        "problem": problem,
        "split": any(hasattr(p, "full_tensor") for p in run.objective.network.parameters()),
    }
    (run.folder / f"process_{rank}.json").write_text(json.dumps(seen))
    if rank == 0 and measured:
        save_file({key: value.contiguous() for key, value in measured.items()}, run.folder / "measured.safetensors")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(*sys.argv[1:])
