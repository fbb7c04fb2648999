"""Pictures from prompts by the stock FLUX.1-schnell: 4 steps, guidance 1 (paper, Sec. 4.3). Not yet run."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

_WHOLE_BYTES = 36 << 30
"""bf16 FLUX with both text encoders, and room to work."""


class TextToImage:
    """A loaded pipeline."""

    def __init__(self, pipeline: Any, device: torch.device, size: tuple[int, int], say: Callable[[str], None]) -> None:
        """`size`: width and height, px."""
        self._pipeline, self._size = pipeline, size
        if device.type == "cuda" and torch.cuda.mem_get_info(device)[0] < _WHOLE_BYTES:
            say("painter: parts are fetched from the CPU in turn, since all together do not fit")
            pipeline.enable_model_cpu_offload()
        else:
            pipeline.to(device)

    def generate(self, prompt: str, *, seed: int) -> Float[Tensor, "h w 3"]:
        """The picture of a prompt and a seed."""
        width, height = self._size
        made = self._pipeline(
            prompt,
            width=width,
            height=height,
            num_inference_steps=4,
            guidance_scale=1.0,
            generator=torch.Generator().manual_seed(seed),
        ).images[0]
        return torch.from_numpy(np.array(made.convert("RGB"))).float() / 255
