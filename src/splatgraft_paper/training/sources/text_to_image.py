"""Images from prompts by the stock FLUX.1-schnell pipeline: 4 steps, guidance 1 (paper, Sec. 5.3).

Untested with the real weights.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

_PIPELINE_BYTES = 36 << 30
"""GPU memory of bf16 FLUX with both text encoders and its activations. An estimate."""


class TextToImage:
    """A loaded text-to-image pipeline."""

    def __init__(self, pipeline: Any, device: torch.device, size: tuple[int, int], say: Callable[[str], None]) -> None:
        """Move a pipeline to a device.

        Args:
            pipeline: a `FluxPipeline`.
            device: where it runs; its parts stay on the CPU in turn where GPU memory does not suffice.
            size: width and height of the images, pixels.
            say: receives a message where parts stay on the CPU.
        """
        self._pipeline, self._size = pipeline, size
        if device.type == "cuda" and torch.cuda.mem_get_info(device)[0] < _PIPELINE_BYTES:
            say("text to image: parts are fetched from the CPU in turn, since GPU memory does not hold all of them")
            pipeline.enable_model_cpu_offload()
        else:
            pipeline.to(device)

    def generate(self, prompt: str, *, seed: int) -> Float[Tensor, "h w 3"]:
        """Generate the image of a prompt and a seed, sRGB in [0, 1]."""
        width, height = self._size
        image = self._pipeline(
            prompt,
            width=width,
            height=height,
            num_inference_steps=4,
            guidance_scale=1.0,
            generator=torch.Generator().manual_seed(seed),
        ).images[0]
        return torch.from_numpy(np.array(image.convert("RGB"))).float() / 255
