"""Training of image models in latent space: objectives, a disk cache of latents, and validation on pairs."""

import hashlib
import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.core.image_metrics import psnr, ssim
from splatgraft.harmonization.flux.loading import load_autoencoder
from splatgraft.harmonization.flux.prompt import PROMPT_FILE
from splatgraft.harmonization.flux.tensor_file import read_tensors, write_tensors
from splatgraft.project.step import locked
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_folder
from splatgraft_paper.training.loop import LoopOptions, Validation, join_processes, train
from splatgraft_paper.training.pairs import PairFiles, Role, TrainingData, crop_pair_to_size, write_split

MODEL_FOLDER = "model"
Latents = Mapping[str, Tensor]
"""Latents (b c h w) by role."""
Network = Callable[..., Any]
"""Call of the objective's network, possibly split over processes or in bfloat16."""


class Objective(ABC):
    """A network between latents of an autoencoder, with its loss."""

    network: Any
    """Torch module; requires_grad is off for frozen parameters."""
    roles: tuple[Role, ...]
    """Images of a pair that the loss needs."""
    output_role: Role
    """Image that the network learns to generate."""

    def __init__(self, folder: Path) -> None:
        """Load the frozen autoencoder of a model's folder."""
        self.folder = folder
        self.autoencoder = load_autoencoder(folder / "vae")
        self.autoencoder.network.eval().requires_grad_(False)

    @abstractmethod
    def to(self, device: Any) -> None:
        """Move the frozen parts to a device."""
        self.autoencoder.network.to(device)

    @abstractmethod
    def loss(self, network: Network, latents: Latents, seeds: Sequence[int]) -> Float[Tensor, ""]:
        """Compute the loss of a batch with one noise seed per pair; `network` calls `self.network`."""

    @abstractmethod
    def predict(self, network: Network, latents: Latents, seed: int) -> Float[Tensor, "b 3 h w"]:
        """Generate the images of a batch, sRGB in [0, 1]."""

    @abstractmethod
    def save(self, state: dict[str, Tensor], folder: Path) -> None:
        """Write the weights `state` in the format of inference."""

    def save_model(self, kind: Any, state: Mapping[str, Tensor], folder: Path, prompt: Path) -> None:
        """Write the network, the autoencoder and the prompt's embeddings.

        `save_pretrained` takes no weights, and the network in training may be split over processes and has the last
        weights instead of their average. So an empty model of the same config receives `state` first.
        """
        with torch.device("meta"):
            empty = kind.from_config(self.network.config)
        empty.load_state_dict(state, strict=True, assign=True)
        with atomic_folder(folder) as new:
            empty.save_pretrained(new)
        self.autoencoder.network.save_pretrained(folder.parent / "vae")
        shutil.copyfile(prompt, folder.parent / PROMPT_FILE)


@dataclass(frozen=True)
class LoadedPair:
    """Latents and images of one pair, by role."""

    latents: dict[str, Tensor]
    """Latents found in the cache."""
    pictures: dict[str, Tensor]
    """Images (3 h w) whose latents are not in the cache."""
    paths: dict[str, Path]
    """Cache file of each role."""
    seed: int = 0
    """Seed of the pair's noise."""


class LatentCache:
    """Latents of one autoencoder at one size, by image; always rounded to bfloat16, even before they are stored."""

    def __init__(
        self, folder: Path, encode: Callable[[Tensor], Tensor], *, width: int, height: int, autoencoder: str
    ) -> None:
        """Open the cache in `folder`; `encode` is a method of the autoencoder, whose weights its name identifies."""
        self._folder, self._encode = folder, encode
        self._size, self._key_prefix = (width, height), f"{autoencoder}|{width}x{height}"

    def load(self, pair: PairFiles, roles: Sequence[Role], seed: int = 0) -> LoadedPair:
        """Read a pair's cached latents, and the images whose latents are missing."""
        paths = {role: self._path(pair.key(role)) for role in roles}
        latents = {role: read_tensors(path)["latents"] for role, path in paths.items() if path.is_file()}
        missing = [role for role in roles if role not in latents]
        pictures: dict[str, Tensor] = {}
        if missing:
            read = crop_pair_to_size(pair.read(), *self._size)
            pictures = {role: read.picture(role).permute(2, 0, 1) for role in missing}
        return LoadedPair(latents, pictures, paths, seed)

    def encode_missing(
        self, loaded: Sequence[LoadedPair], roles: Sequence[Role]
    ) -> dict[str, Float[Tensor, "b c h w"]]:
        """Batch the latents of several pairs by role; encode missing ones and write them to the cache."""
        batch: dict[str, list[Tensor]] = {role: [] for role in roles}
        for item in loaded:
            for role in roles:
                latents = item.latents.get(role)
                if latents is None:
                    # one at a time, because rounding depends on the batch and a resumed run would not be bit-identical
                    latents = self._encode(item.pictures[role][None])[0].to("cpu", torch.bfloat16)
                    _write_latents(item.paths[role], latents)
                batch[role].append(latents.float())
        return {role: torch.stack(latents) for role, latents in batch.items()}

    def _path(self, key: str) -> Path:
        name = hashlib.sha256(f"{self._key_prefix}|{key}".encode()).hexdigest()
        return self._folder / name[:2] / f"{name}.safetensors"


class ObjectiveTask:
    """An objective on a mixture of pairs, as a task of the training loop."""

    def __init__(self, objective: Objective, data: TrainingData, cache: LatentCache, options: LoopOptions) -> None:
        """Move the objective to the device of this process."""
        self.network: nn.Module = objective.network
        self.objective, self.data, self._cache, self._options = objective, data, cache, options
        self._device = join_processes(options).device
        objective.to(self._device)
        counts = zip(data.mixture.names, map(len, data.mixture.pairs), strict=True)
        self.fingerprint: Mapping[str, Any] = {"data": [list(entry) for entry in counts]}

    def optimizer(self) -> torch.optim.Optimizer:
        """Make Adam without weight decay (paper, Sec. 5.3)."""
        return torch.optim.Adam([p for p in self.network.parameters() if p.requires_grad], lr=self._options.rate)

    def rate_at(self, step: int) -> float:
        """Return the learning rate at a step, counted from 0; it is constant after the warm-up."""
        warm_up = self._options.warm_up
        return self._options.rate * min(1.0, (step + 1) / warm_up) if warm_up else self._options.rate

    def read(self, position: int) -> LoadedPair:
        """Read the pair at a position; its noise seed does not depend on the number of processes."""
        digest = hashlib.sha256(f"{self._options.seed}|{position}".encode()).digest()
        pair = self.data.mixture.draw(position)
        return self._cache.load(pair, self.objective.roles, int.from_bytes(digest[:7], "big"))

    def loss(self, network: Network, items: Sequence[LoadedPair]) -> Float[Tensor, ""]:
        """Compute the objective's loss."""
        return self.objective.loss(network, self._latents(items), [item.seed for item in items])

    def name(self, position: int) -> str:
        """Return the file of the relit object."""
        return str(self.data.mixture.draw(position).relit)

    def _latents(self, items: Sequence[LoadedPair]) -> dict[str, Tensor]:
        latents = self._cache.encode_missing(items, self.objective.roles)
        return {role: tensor.to(self._device) for role, tensor in latents.items()}

    @torch.no_grad()
    def validate(self, network: Network) -> Validation | None:
        """Measure predictions and the network's input; a row of the sheet has input, prediction and target."""
        objective, mixture = self.objective, self.data.held_out or self.data.mixture
        rows, found = [], []
        for files in mixture.all()[: self._options.validation_pairs]:
            latents = self._latents([self._cache.load(files, objective.roles)])
            predicted = objective.predict(network, latents, self._options.seed)[0].permute(1, 2, 0).float().cpu()
            pair = crop_pair_to_size(files.read(), predicted.shape[1], predicted.shape[0])
            target = pair.picture(objective.output_role)
            given = pair.composite if objective.output_role == "target" else pair.target
            inside = pair.mask > 0.5
            inside = inside if bool(inside.any()) else torch.ones_like(inside)
            found.append(
                {
                    "psnr": float(psnr(predicted, target)),
                    "ssim": float(ssim(predicted, target)),
                    "psnr_object": float(psnr(predicted, target, inside)),
                    "psnr_input": float(psnr(given, target)),
                    "psnr_object_input": float(psnr(given, target, inside)),
                }
            )
            rows.append(torch.cat([given, predicted, target], 1))
        if not rows:
            return None
        m = {name: round(sum(values[name] for values in found) / len(found), 4) for name in found[0]}
        label = "held out" if self.data.held_out else "training pairs: no scene is held out"
        sentence = (
            f"PSNR {m['psnr']:.2f} dB (input {m['psnr_input']:.2f}), object {m['psnr_object']:.2f} "
            f"(input {m['psnr_object_input']:.2f}), SSIM {m['ssim']:.3f} ({label})"
        )
        return Validation(m, sentence, torch.cat(rows, 0))


def train_objective(
    objective: Objective, data: TrainingData, out: Path, options: LoopOptions, *, base: Path, console: Console
) -> Path | None:
    """Train an objective with `base`'s autoencoder, write its model, and return its folder in the first process."""
    processes = join_processes(options)
    first = processes.is_main_process
    say = console.say if first else lambda sentence: None
    if processes.num_processes > 1:
        held = "a share of the weights" if options.parallel == "shards" else "all weights"
        say(f"processes: {processes.num_processes} on {processes.device.type}, {held} in each")
    for line in data.lines:
        say(line)
    vae = base / "vae" / "diffusion_pytorch_model.safetensors"
    name = f"{vae.resolve()}|{vae.stat().st_size if vae.is_file() else 0}"
    cache = LatentCache(
        out / "latents", objective.autoencoder.encode, width=data.width, height=data.height, autoencoder=name
    )
    task = ObjectiveTask(objective, data, cache, options)
    # only the first process locks the folder; the others write only latents, each file atomically
    with console.bar("train") as progress, locked(out) if first else nullcontext():
        state = train(task, options, out, say=say, progress=progress)
        if first:
            objective.save(state, out / MODEL_FOLDER)
            write_split(out / MODEL_FOLDER, data.split)
    processes.wait_for_everyone()
    return out / MODEL_FOLDER if first else None


def _write_latents(path: Path, latents: Float[Tensor, "c h w"]) -> None:
    """Write latents; via a temporary file per process, because several may encode the same image at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.stem}-{os.getpid()}.safetensors")
    write_tensors(temporary, {"latents": latents})
    os.replace(temporary, path)
