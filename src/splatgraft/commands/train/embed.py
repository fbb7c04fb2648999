"""The command `train embed`: the empty prompt's embeddings as a file, so that no text encoder is loaded later."""

from dataclasses import dataclass
from typing import Literal

from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console


@dataclass(frozen=True)
class TrainEmbed:
    """Compute the empty prompt's embeddings of FLUX (T5 and CLIP) or Stable Diffusion, or IC-Light's prompts."""

    out: Positional
    """File to write: empty_prompt.safetensors; a file beside the weights is found without an option."""
    base: str = "black-forest-labs/FLUX.1-schnell"
    """Folder or hub id with the text encoders and tokenizers."""
    tokens: int = 256
    """Length of FLUX's text sequence; schnell was distilled at 256."""
    kind: Literal["flux", "stable-diffusion", "ic-light"] = "flux"
    """The model whose text encoders are used; needs transformers (pip install 'splatgraft[text]')."""

    def execute(self, console: Console) -> int:
        """Write the file."""
        from splatgraft.harmonization.flux.weights.text_encoders import (
            embed_empty_prompt,
            embed_empty_prompt_stable_diffusion,
            embed_ic_light_prompts,
        )

        if self.kind == "flux":
            embed_empty_prompt(self.base, self.out, tokens=self.tokens, say=console.say)
        elif self.kind == "stable-diffusion":
            embed_empty_prompt_stable_diffusion(self.base, self.out, say=console.say)
        else:
            embed_ic_light_prompts(self.base, self.out, say=console.say)
        console.result(self.out)
        return 0


COMMAND = TrainEmbed
