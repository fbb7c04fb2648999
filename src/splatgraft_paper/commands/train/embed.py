"""The command `train embed`: the empty prompt's embeddings as a file, so that no text encoder is loaded later."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from splatgraft.runtime.console import Console
from splatgraft.runtime.weights.catalogue import find_model
from splatgraft.runtime.weights.store import folder_of

_BASES = {
    "flux": find_model("flux-schnell").repository,
    "stable-diffusion": find_model("stable-diffusion-2").repository,
    "ic-light": find_model("realistic-vision").repository,
}
"""Default base by kind."""


@dataclass(frozen=True)
class TrainEmbed:
    """Compute the empty prompt's embeddings of FLUX (T5 and CLIP) or Stable Diffusion, or IC-Light's prompts."""

    out: Annotated[Path | None, tyro.conf.Positional] = None
    """File to write; where `harmonize` and `train` look, unless given: in the folder --base, or that of its weights."""
    base: str | None = None
    """Folder or hub id with the text encoders and tokenizers; the default base of --kind where not given."""
    tokens: int = 256
    """Length of FLUX's text sequence; schnell was distilled at 256."""
    kind: Literal["flux", "stable-diffusion", "ic-light"] = "flux"
    """The model whose text encoders are used; needs transformers (pip install 'splatgraft[text]')."""

    def execute(self, console: Console) -> int:
        """Write the file."""
        from splatgraft.harmonization.flux.empty_prompt import PROMPT_FILE
        from splatgraft.harmonization.flux.weights.text_encoders import (
            IC_LIGHT_PROMPT_FILE,
            embed_empty_prompt,
            embed_empty_prompt_stable_diffusion,
            embed_ic_light_prompts,
        )

        base = self.base or _BASES[self.kind]
        folder = Path(base) if Path(base).is_dir() else folder_of("/".join(base.split("/")[:2]))
        out = self.out or folder / (IC_LIGHT_PROMPT_FILE if self.kind == "ic-light" else PROMPT_FILE)
        out.parent.mkdir(parents=True, exist_ok=True)
        if self.kind == "flux":
            embed_empty_prompt(base, out, tokens=self.tokens, say=console.say)
        elif self.kind == "stable-diffusion":
            embed_empty_prompt_stable_diffusion(base, out, say=console.say)
        else:
            embed_ic_light_prompts(base, out, say=console.say)
        console.result(out)
        return 0


COMMAND = TrainEmbed
