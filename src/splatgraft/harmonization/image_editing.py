"""Harmonisation with an open image-editing model: any pipeline of diffusers that takes an image and a prompt.

The paper compares with such a model behind a service (Sec. 7, Nano Banana); its prompt is the default here.
"""

import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from splatgraft.core.images import resize
from splatgraft.harmonization.flux.loading import diffusers_library
from splatgraft.harmonization.flux.tensor_file import one_line
from splatgraft.harmonization.interface import HarmonizerContext, HarmonizerInputs

PROMPT = (
    "I copy-pasted an object from one photograph to the other. I will give you the photograph and the mask of the "
    "copied object, white is the object and black is the background. Edit the photograph such that the copied object "
    "looks realistically composited in the environment. Create realistic contact shadows, ambient occlusion, global "
    "illumination, accurate lighting match, seamless blending etc. This is crucial: Do not change anything else other "
    "than the composited object."
)
"""The paper's prompt, verbatim."""
_REACH, _FEATHER = 1.0, 0.5
"""Width of the neighbourhood that may change, and of the band in which it fades out, over the root of the area."""
_SEVERAL = ("Flux2", "QwenImageEditPlus")
"""First letters of the names of pipelines that take several pictures: here composite and mask."""


def load_editor(
    model: str, context: HarmonizerContext, *, prompt: str | None, seed: int, sampling_steps: int | None
) -> "ImageEditor":
    """Load a pipeline from a folder or the hub.

    On CUDA it runs in bfloat16 with one part on the card at a time, on the CPU in float32.

    Args:
        model: Folder or hub id.
        context: Device, and where messages go.
        prompt: Instruction to the model; None takes the paper's.
        seed: Seed of the noise.
        sampling_steps: Number of sampling steps; None takes the pipeline's own.

    Raises:
        ValueError: There is no such pipeline, or it does not take an image and a prompt.
    """
    on_cuda = context.device.type == "cuda"
    if not Path(model).exists():
        context.say(f"weights: {model} of the Hugging Face hub; its licence: https://huggingface.co/{model}")
    try:
        pipeline: Any = diffusers_library().DiffusionPipeline.from_pretrained(
            model, torch_dtype=torch.bfloat16 if on_cuda else torch.float32
        )
    except (OSError, ValueError, AttributeError, RuntimeError) as error:
        where = "a folder" if Path(model).exists() else "a folder or hub id"
        raise ValueError(
            f"--model {model}: expected {where} of a diffusers pipeline, found {one_line(error)}"
        ) from error
    name, known = type(pipeline).__name__, inspect.signature(pipeline.__call__).parameters
    if not {"image", "prompt"} <= set(known):
        raise ValueError(f"--model {model}: expected a pipeline that takes an image and a prompt, found {name}")
    pipeline.set_progress_bar_config(disable=True)
    if on_cuda:
        pipeline.enable_model_cpu_offload(device=context.device)
    takes_mask = name.startswith(_SEVERAL)
    context.say(f"edit: {name} of {model}, given " + ("composite and mask" if takes_mask else "the composite alone"))
    settings: dict[str, Any] = {"prompt": prompt or PROMPT}
    if sampling_steps is not None:
        settings["num_inference_steps"] = sampling_steps
    return ImageEditor(pipeline, takes_mask, frozenset(known), settings, seed)


@dataclass(frozen=True)
class ImageEditor:
    """An image-editing pipeline as a harmoniser; all views begin with the same noise."""

    pipeline: Any
    takes_mask: bool
    """Whether the mask is given as a second picture."""
    parameters: frozenset[str]
    """Names of the parameters that the pipeline takes."""
    settings: dict[str, Any]
    """Arguments of every call: prompt and number of steps."""
    seed: int

    def harmonize(self, view: HarmonizerInputs) -> Float[Tensor, "h w 3"]:
        """Edit the composite; pixels away from the object keep the composite's colours."""
        height, width = view.mask.shape
        composite, mask = _picture(view.composite), _picture((view.mask > 0.5).float()[..., None].expand(-1, -1, 3))
        size = {"height": height, "width": width}
        made = self.pipeline(
            image=[composite, mask] if self.takes_mask else composite,
            # drawn on the CPU, so that the noise is the same on every device
            generator=torch.Generator().manual_seed(self.seed),
            **{name: value for name, value in size.items() if name in self.parameters},
            **self.settings,
        ).images[0]
        edited = torch.from_numpy(np.array(made.convert("RGB"))).float() / 255
        edited = resize(edited, width, height).clamp(0, 1)
        return torch.lerp(view.composite.cpu(), edited, near_object(view.mask)[..., None])


def near_object(mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Compute the share of the edit in each pixel: 1 up to the root of the area around the object, then down to 0."""
    inside = (mask.cpu() > 0.5).numpy()
    if not inside.any():
        return torch.zeros(mask.shape)
    unit = float(inside.sum()) ** 0.5
    distance = torch.from_numpy(cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5))
    return (1 - (distance - _REACH * unit) / (_FEATHER * unit)).clamp(0, 1)


def _picture(image: Float[Tensor, "h w 3"]) -> Image.Image:
    return Image.fromarray((image * 255).round().to(torch.uint8).cpu().numpy())
