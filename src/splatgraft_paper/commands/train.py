"""The commands `paper train ...`, for the paper's harmoniser and its object removal."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from splatgraft.harmonization.flux.prompt import TOKENS
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.runtime.hub import hub_id
from splatgraft_paper.training.flux import FluxTrainingOptions, train_flux
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
