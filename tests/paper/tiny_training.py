"""Trainings of tiny models, also as a program that torchrun starts in several processes.

python tiny_training.py FOLDER '[["NAME", {"loop": {...}, "lora": 2}], ...]' trains one after the other in FOLDER/NAME.
It writes what each process saw, process_RANK.json, and the weights that validation measured, measured.safetensors.
"""

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from tiny_models import flux_folder
from tiny_pairs import relit_folder

from splatgraft_paper.training.flux import FluxObjective, FluxTrainingOptions
from splatgraft_paper.training.loop import LoopOptions, train
from splatgraft_paper.training.objective import MODEL_FOLDER, LatentCache, ObjectiveTask
from splatgraft_paper.training.pairs import TrainingData, open_relit, split_mixture

QUICK = LoopOptions(
    steps=6, batch=2, rate=1e-3, precision="no", save_every=2, validate_every=3, validation_pairs=2, readers=1, cpu=True
)


def read_losses(path):
    """Read the loss of each step, in order."""
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    return [entry["loss"] for entry in entries if "loss" in entry]


def silent(*words):
    pass


@dataclass(frozen=True)
class Run:
    """Training as `train` takes it."""

    task: ObjectiveTask
    cache: LatentCache
    loop: LoopOptions
    folder: Path
    progress: object = silent
    say: object = silent

    def train(self) -> Path:
        """Train and write the model."""
        state = train(self.task, self.loop, self.folder, say=self.say, progress=self.progress)
        if state:
            self.task.objective.save(state, self.folder / MODEL_FOLDER)
        return self.folder / MODEL_FOLDER


def run_of(objective, folders, loop, folder, *, held_out=0.5, progress=silent, say=silent):
    mixture, kept = split_mixture(folders, weights=[1.0] * len(folders), held_out=held_out, seed=loop.seed)
    cache = LatentCache(
        folder.parent / "latents", objective.autoencoder.encode, width=32, height=32, autoencoder="tiny"
    )
    task = ObjectiveTask(objective, TrainingData(mixture, kept, 32, 32), cache, loop)
    return Run(task, cache, loop, folder, progress, say)


def training(tmp_path, name, loop=QUICK, *, pairs=2, progress=silent, say=silent, folders=None, **flux):
    base, folder = tmp_path / "base", tmp_path / "pairs"
    if not base.is_dir():
        flux_folder(base)
        relit_folder(folder, pairs)
    objective = FluxObjective(base, FluxTrainingOptions(loop=loop, **flux), say)
    held_out = 0.0 if folders else 0.5
    return run_of(objective, folders or [open_relit(folder)], loop, tmp_path / name, held_out=held_out,
                  progress=progress, say=say)  # fmt: skip


def measured_by(run):
    """Record the network's weights at each validation in a dictionary, which is filled while training."""
    measured, plain = {}, run.task.validate

    def validate(network):
        measured.clear()
        for name, value in run.task.network.state_dict().items():
            measured[name] = (value.full_tensor() if hasattr(value, "full_tensor") else value).detach().clone()
        return plain(network)

    run.task.validate = validate
    return measured


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

    loop = replace(QUICK, **given.pop("loop", {}))
    inside, pattern = folder / given.pop("inside", ""), given.pop("remove", None)
    run, problem = training(inside, name, loop, **given), None
    measured = measured_by(run)
    if pattern:

        def remove(done, total, message):
            for path in (inside / "pairs").glob(pattern):
                path.unlink()

        run = replace(run, progress=remove)
    try:
        run.train()
    except ValueError as error:
        problem = str(error)
    together = dist.is_initialized()
    rank = dist.get_rank() if together else 0
    seen = {
        "processes": dist.get_world_size() if together else 1,
        "backend": dist.get_backend() if together else None,
        "problem": problem,
        "split": any(hasattr(p, "full_tensor") for p in run.task.network.parameters()),
    }
    (run.folder / f"process_{rank}.json").write_text(json.dumps(seen))
    if rank == 0 and measured:
        save_file({key: value.contiguous() for key, value in measured.items()}, run.folder / "measured.safetensors")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(*sys.argv[1:])
