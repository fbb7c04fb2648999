"""The harmonisation methods by name: the options of each, and the harmoniser that they make."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.interface import Harmonizer, HarmonizerContext, HarmonizerInputs


@runtime_checkable
class HarmonizerOptions(Protocol):
    """Options of one method; `make` imports its heavy libraries."""

    name: ClassVar[str]
    """The method's name."""

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Make the harmoniser."""
        ...


@dataclass(frozen=True)
class NoneOptions:
    """Keep the light transfer's result: no image model."""

    name: ClassVar[str] = "none"

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Make the harmoniser."""
        return _Identity()


class _Identity:
    """Harmoniser that returns the prior unchanged."""

    def harmonize(self, view: HarmonizerInputs) -> Float[Tensor, "h w 3"]:
        """Return the tensor `view.prior` itself."""
        return view.prior


@dataclass(frozen=True)
class FluxOptions:
    """The paper's image model: FLUX.1-schnell fine-tuned on pairs (Sec. 5)."""

    name: ClassVar[str] = "flux"

    weights: str | None = None
    """Folder or hub id of the weights, which must be given; `dot3d` names the authors' (nviolante/dot3d)."""
    base: str | None = None
    """Folder or hub id of the model from which the weights were trained, for the parts that they lack."""
    lora: Path | None = None
    """A low-rank adaptation (lora.safetensors) to merge into the weights."""
    variant: Literal["auto", "image-mask", "image-background"] = "auto"
    """Second input of the network, beside the composite; auto reads it from the weights' folder."""
    seed: int = 0
    """Seed of the noise, shared by all views."""
    sampling_steps: int = 4
    """Number of sampling steps."""
    precision: Literal["auto", "bf16", "fp8", "offload", "float32"] = "auto"
    """Storage of the weights: fp8 in 8 bits, offload on the CPU; auto takes the best that fits the free memory."""

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Load the network."""
        if self.weights is None:
            raise ValueError(
                "harmonizer flux: expected --weights FOLDER or dot3d (nviolante/dot3d of the hub, 24 GB, by "
                "the paper's authors under their own licence), found none"
            )
        from splatgraft.harmonization.flux.harmonizer import FluxHarmonizer
        from splatgraft.harmonization.flux.loading import FluxFiles, load_flux

        files = FluxFiles(self.weights, self.base, self.lora, self.variant)
        network = load_flux(files, context, precision=self.precision, sampling_steps=self.sampling_steps)
        return FluxHarmonizer(network, seed=self.seed, steps=self.sampling_steps)


@dataclass(frozen=True)
class EditOptions:
    """An open image-editing model with a prompt, such as FLUX.1 Kontext, FLUX.2 or Qwen-Image-Edit."""

    name: ClassVar[str] = "edit"

    model: str | None = None
    """Folder or hub id of a diffusers pipeline that takes an image and a prompt, which must be given."""
    prompt: str | None = None
    """Instruction to the model; the paper's prompt (Sec. 7) by default."""
    seed: int = 0
    """Seed of the noise, shared by all views."""
    sampling_steps: int | None = None
    """Number of sampling steps; the pipeline's own by default."""

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Load the pipeline."""
        if self.model is None:
            raise ValueError(
                "harmonizer edit: expected --model FOLDER or a hub id such as Qwen/Qwen-Image-Edit-2509 (mind the "
                "licence of each), found none"
            )
        from splatgraft.harmonization.image_editing import load_editor

        return load_editor(self.model, context, prompt=self.prompt, seed=self.seed, sampling_steps=self.sampling_steps)


HARMONIZERS: dict[str, type[HarmonizerOptions]] = {kind.name: kind for kind in (NoneOptions, FluxOptions, EditOptions)}
"""Options of each method, by its name."""


def make_harmonizer(method: str | HarmonizerOptions, context: HarmonizerContext = HarmonizerContext()) -> Harmonizer:
    """Make a harmoniser.

    Args:
        method: The options of a method, or its name for the default options.
        context: Device, number and size of the views, and where messages go.

    Raises:
        ValueError: There is no method of that name (the message lists the names), or its weights or packages are
            missing.
    """
    if isinstance(method, str):
        if method not in HARMONIZERS:
            raise ValueError(f"harmonizer: expected one of {', '.join(sorted(HARMONIZERS))}, found {method!r}")
        method = HARMONIZERS[method]()
    return method.make(context)
