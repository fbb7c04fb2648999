"""The commands `paper train ...`, for the paper's harmoniser, its object removal, and the compact harmoniser."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from splatgraft.harmonization.flux.prompt import TOKENS
from splatgraft.project.step import Device, Positional, choose_device
from splatgraft.runtime.console import Console
from splatgraft.runtime.hub import hub_id
from splatgraft_paper.synthesis.pairs import read_manifest
from splatgraft_paper.training.compact.loop import CompactOptions, CompactTask
from splatgraft_paper.training.compact.pairs import CompactPairs, HeldOutOptions
from splatgraft_paper.training.compact.priors import write_priors
from splatgraft_paper.training.flux import FluxTrainingOptions, train_flux
from splatgraft_paper.training.loop import train
from splatgraft_paper.training.recipes import arguments_with_recipe
from splatgraft_paper.training.removal import RemovalTrainingOptions, train_removal


@dataclass(frozen=True)
class TrainFlux:
    """Train the paper's harmoniser; a killed run is continued. Many GPUs: `torchrun -m splatgraft paper train`."""

    out: Positional
    """Folder for the model, states, log and validation pictures."""
    options: FluxTrainingOptions = field(default_factory=FluxTrainingOptions)

    @staticmethod
    def current_arguments(words: list[str], say: Callable[[str], None]) -> list[str]:
        """Put the options of --recipe before the user's own arguments."""
        return arguments_with_recipe("train flux", words)

    def execute(self, console: Console) -> int:
        """Train, and print the folder of the model."""
        model = train_flux(self.out, self.options, console)
        if model is not None:
            console.result(model)
        return 0


@dataclass(frozen=True)
class TrainRemoval:
    """Train the object removal on Stable Diffusion 2 (v-prediction); a killed run is continued."""

    out: Positional
    """Folder for the model, states, log and validation pictures."""
    options: RemovalTrainingOptions = field(default_factory=RemovalTrainingOptions)

    @staticmethod
    def current_arguments(words: list[str], say: Callable[[str], None]) -> list[str]:
        """Put the options of --recipe before the user's own arguments."""
        return arguments_with_recipe("train removal", words)

    def execute(self, console: Console) -> int:
        """Train, and print the folder of the model."""
        model = train_removal(self.out, self.options, console)
        if model is not None:
            console.result(model)
        return 0


@dataclass(frozen=True)
class TrainCompact:
    """Train the compact harmoniser; a killed run is continued."""

    out: Positional
    """Folder for compact.safetensors, priors/, state, log and validation pictures."""
    pairs: Path
    """Folder that `splatgraft paper synth pairs` rendered."""
    loop: CompactOptions = field(default_factory=CompactOptions)
    held_out: HeldOutOptions = field(default_factory=HeldOutOptions)
    device: Device = "auto"

    def execute(self, console: Console) -> int:
        """Write the missing priors, train, write the weights."""
        from splatgraft.harmonization.compact.network import SHIPPED, write_weights

        device = choose_device(self.device, console)
        samples = read_manifest(self.pairs)
        folders = sorted({sample.folder for sample in samples})
        self.out.mkdir(parents=True, exist_ok=True)
        with console.bar("priors") as progress:
            write_priors(folders, self.out / "priors", seed=self.loop.seed, progress=progress)
        with console.bar("read") as progress:
            pairs = CompactPairs(self.pairs, self.out / "priors", self.held_out, progress)
        console.say(f"{len(pairs.training)} pairs to train on, {len(pairs.validation)} held out")
        with console.bar("train") as progress:
            options = self.loop.loop(cpu=device.type == "cpu")
            state = train(CompactTask(pairs, self.loop, device), options, self.out, say=console.say, progress=progress)
        notes = {
            "pairs": json.dumps({"folders": [folder.name for folder in folders], **pairs.fingerprint()}),
            "steps": str(self.loop.steps),
            "seed": str(self.loop.seed),
        }
        write_weights(self.out / SHIPPED.name, self.loop.network, state, notes)
        console.say(f"{self.out / SHIPPED.name}")
        return 0


@dataclass(frozen=True)
class TrainEmbed:
    """Compute the empty prompt's embeddings of FLUX (T5 and CLIP) or Stable Diffusion (CLIP)."""

    out: Annotated[Path | None, tyro.conf.Positional] = None
    """File to write; default: the place where `harmonize` and `train` look for it."""
    base: str | None = None
    """Folder or hub id with the text encoders and tokenizers; default: the base model of --kind."""
    tokens: int = TOKENS
    """Length of FLUX's text sequence; schnell was distilled at 256."""
    kind: Literal["flux", "stable-diffusion"] = "flux"
    """Model whose text encoders are used; needs transformers (pip install 'splatgraft[text]')."""

    def execute(self, console: Console) -> int:
        """Write the file."""
        from splatgraft.harmonization.flux.prompt import CLIP, embed_empty_prompt, embed_text, prompt_file, write_prompt
        from splatgraft.harmonization.flux.tensor_file import write_tensors

        base = hub_id(self.base or self.kind)
        out = self.out or prompt_file(base)
        out.parent.mkdir(parents=True, exist_ok=True)
        console.say(f"{base}: its text encoders embed the empty prompt")
        if self.kind == "flux":
            write_prompt(out, embed_empty_prompt(base, tokens=self.tokens), base)
        else:
            tokens = embed_text(base, CLIP).last_hidden_state[0].float()
            write_tensors(out, {"tokens": tokens}, {"text": "", "source": base})
        console.result(out)
        return 0
