"""Loads the FLUX harmoniser onto a device, in a precision that fits its memory."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from splatgraft.harmonization.flux.baked_modulation import bake, fuse_projections
from splatgraft.harmonization.flux.empty_prompt import PROMPT_FILE, read_prompt
from splatgraft.harmonization.flux.network import Autoencoder, FluxNetwork
from splatgraft.harmonization.flux.sampling import schnell_levels
from splatgraft.harmonization.flux.weights.diffusers_library import (
    autoencoder_class,
    flux_transformer_class,
    nf4_config,
)
from splatgraft.harmonization.flux.weights.eight_bit import multiplies_in_eight_bits, use_eight_bits
from splatgraft.harmonization.flux.weights.folder import (
    CONDITIONS,
    VARIANTS,
    FluxFolder,
    Variant,
    declared_variant,
    find_part,
    local_folder,
    weights_variant,
)
from splatgraft.harmonization.flux.weights.lora import merge_lora
from splatgraft.harmonization.flux.weights.lora_file import LowRankFile, read_lora
from splatgraft.harmonization.flux.weights.placement import (
    PRECISIONS,
    Placement,
    activation_bytes,
    choose_placement,
    decoder_bytes,
)
from splatgraft.harmonization.flux.weights.widening import FirstLayer, widen_layer
from splatgraft.runtime.weights.store import folder_of

Say = Callable[[str], None]
BASE = "black-forest-labs/FLUX.1-schnell"
_FIRST_LAYER = "x_embedder"


@dataclass(frozen=True)
class FluxWeights:
    """Which weights to load, and how."""

    weights: str
    """Folder or hub id of a harmoniser; of FLUX itself where `lora` is given."""
    base: str | None = None
    """Folder or hub id of vae/ and prompt where `weights` has none; FLUX.1-schnell where not given."""
    lora: Path | None = None
    """A low-rank adaptation of `train flux`, merged into the weights."""
    variant: str = "auto"
    """image-mask, image-background, or auto: as the folder declares."""
    precision: str = "auto"
    """auto, or one of `placement.PRECISIONS`."""
    compiled: bool = False
    """Use torch.compile; worthwhile from about twenty views of one size on."""
    steps: int = 4
    """Sampling steps; the modulations are precomputed for their noise levels."""
    strengths: tuple[float, ...] = (1.0,)
    """Noise levels that sampling will start from, in (0, 1]."""


def load_flux(
    options: FluxWeights, device: torch.device, *, say: Say, pixels: int = 704 * 496, views: int = 1
) -> FluxNetwork:
    """Load the network, with precomputed modulations and fused projections.

    Args:
        options: weights and options.
        device: where the network runs.
        say: receives messages on downloads, precision and parameters.
        pixels: of one view, for the memory estimate.
        views: per pass, for the memory estimate.

    Raises:
        ValueError: a folder is of another kind, a file is broken, or memory does not suffice.
    """
    if options.precision not in ("auto", *PRECISIONS):
        raise ValueError(f"--precision: expected auto, {', '.join(PRECISIONS)}, found {options.precision}")
    folder = local_folder(options.weights, say)
    checked = FluxFolder.open(folder)
    lora = None if options.lora is None else read_lora(options.lora)
    if lora is not None and checked.inputs == 1:
        variant = _variant_of_lora(options, lora)
    else:
        variant = checked.variant(options.variant)
    base = _Base(folder, options.base, say)
    config = checked.config
    prompt = read_prompt(
        find_part(PROMPT_FILE, folder, *base.folders(PROMPT_FILE)),
        tokens_width=config.get("joint_attention_dim", 4096),
        pooled_width=config.get("pooled_projection_dim", 768),
    )
    autoencoder = load_autoencoder(find_part("vae", folder, *base.folders("vae")))
    placement = _placement(options, checked, device, (pixels, views), autoencoder)
    say(placement.sentence)
    dtype = torch.float32 if placement.precision == "float32" else torch.bfloat16
    transformer = load_transformer(checked, dtype=dtype, quantized=placement.precision == "nf4")
    if lora is not None:
        if placement.precision == "nf4":
            raise ValueError(f"{options.lora}: expected a precision that weights can be added to, found nf4")
        if checked.inputs == 1:
            # a low-rank first layer counts from zeros, as diffusers widens for it; ours is stored whole
            widen_transformer(transformer, "zero" if _FIRST_LAYER in lora.updates else "repeat")
        say(f"lora: {merge_lora(transformer, lora)} layers adapted by {options.lora}")
        if lora.unused:
            say(f"lora: {lora.unused} tensors of text encoders are not used, since the prompt is precomputed")
    transformer.eval().requires_grad_(False)
    prompt = prompt.to(torch.device("cpu"), dtype)
    guidance = checked.guidance
    if guidance is not None:
        say(f"flux: a guidance-distilled network (FLUX.1-dev); guidance {guidance:g}, noise levels in equal steps")
    levels = sorted({level for start in options.strengths for level in schnell_levels(options.steps, start=start)[:-1]})
    removed = bake(transformer, prompt, tuple(levels), guidance=guidance)
    if placement.precision != "nf4":
        fuse_projections(transformer)
    say(f"flux: {removed / 1e9:.2f} billion parameters of modulation replaced by a table")
    if (more := _place(transformer, placement, device, dtype)) is not None:
        say(more)
    autoencoder.network.to(device, dtype).eval().requires_grad_(False)
    if placement.tiled:
        autoencoder.network.enable_tiling()
    if options.compiled:
        transformer.compile_repeated_blocks()
    return FluxNetwork(
        transformer, autoencoder, prompt.to(device, dtype), variant, device, dtype, options.steps, options.strengths
    )


def load_transformer(checked: FluxFolder, *, dtype: torch.dtype, quantized: bool = False) -> Any:
    """Load the transformer of a checked folder, on the CPU (on the GPU where quantised).

    Raises:
        ValueError: the weights do not fit the config.
    """
    settings = {"quantization_config": nf4_config(dtype)} if quantized else {}
    folder = checked.transformer
    try:
        loaded = flux_transformer_class().from_pretrained(
            folder, torch_dtype=dtype, variant=weights_variant(folder), output_loading_info=True, **settings
        )
    except (OSError, ValueError, RuntimeError) as error:
        found = " ".join(str(error).split())[:200]
        raise ValueError(f"{folder}: expected weights that fit config.json, found {found}") from error
    return _complete(folder, *loaded)


def load_autoencoder(folder: Path) -> Autoencoder:
    """Load the autoencoder in float32 on the CPU.

    Raises:
        ValueError: the folder has none.
    """
    try:
        # a variant in 16 bits becomes float32 too
        loaded = autoencoder_class().from_pretrained(
            folder, torch_dtype=torch.float32, variant=weights_variant(folder), output_loading_info=True
        )
    except (OSError, ValueError, RuntimeError) as error:
        found = " ".join(str(error).split())[:200]
        raise ValueError(f"{folder}: expected an AutoencoderKL, found {found}") from error
    return Autoencoder(_complete(folder, *loaded))


def _complete(folder: Path, model: Any, about: Any) -> Any:
    """The model, where the files had all its weights: of missing ones diffusers only warns."""
    if missing := sorted(about["missing_keys"]):
        raise ValueError(
            f"{folder}: expected all weights of config.json, found {len(missing)} missing: {missing[0]} ..."
        )
    return model


def widen_transformer(transformer: Any, init: FirstLayer = "repeat") -> None:
    """Widen the first layer for composite and condition, in place; the config is updated too."""
    out = transformer.proj_out.out_features
    transformer.x_embedder = widen_layer(transformer.x_embedder, CONDITIONS + 1, init)
    transformer.register_to_config(in_channels=transformer.x_embedder.in_features, out_channels=out)


class _Base:
    """The base model's folder, downloaded only where a part is missing in the weights' folder."""

    def __init__(self, weights: Path, base: str | None, say: Say) -> None:
        self._weights, self._base, self._say = weights, base, say

    def folders(self, name: str) -> tuple[Path, ...]:
        if (self._weights / name).exists():
            return ()
        beside = self._weights.parent  # image-mask/ of a repository whose root has vae/
        if self._base is None and (beside / name).exists():
            return (beside,)
        if self._base is None and name == PROMPT_FILE:
            return (folder_of(BASE),)  # where `train embed` writes it
        return (local_folder(self._base or BASE, self._say, parts=("vae",)),)


def _variant_of_lora(options: FluxWeights, lora: LowRankFile) -> Variant:
    """The variant of an adaptation that makes FLUX a harmoniser."""
    if _FIRST_LAYER not in lora.updates and f"{_FIRST_LAYER}.weight" not in lora.whole:
        raise ValueError(
            f"{options.lora}: expected {_FIRST_LAYER} in an adaptation that makes FLUX a harmoniser, found none; give "
            "the harmoniser that it was trained on as --weights"
        )
    variant = options.variant if options.variant != "auto" else declared_variant(options.lora.parent)  # pyright: ignore
    if variant not in VARIANTS:
        raise ValueError(f"{options.lora}: expected harmonizer.json beside it or --variant, found neither")
    return variant  # pyright: ignore


def _placement(
    options: FluxWeights, checked: FluxFolder, device: torch.device, work: tuple[int, int], autoencoder: Autoencoder
) -> Placement:
    pixels, views = work
    if options.precision != "auto":
        return Placement(options.precision, False, f"flux: {options.precision} on {device}, as requested")  # pyright: ignore
    if device.type != "cuda":
        return Placement("float32", False, f"flux: float32 on {device}; minutes per view at FLUX's size")
    config = checked.config
    width = config.get("num_attention_heads", 24) * config.get("attention_head_dim", 128)
    return choose_placement(
        # without modulation: 12 width^2 per single block and per stream of a double block
        parameters=round(width**2 * (24 * config.get("num_layers", 19) + 12 * config.get("num_single_layers", 38))),
        others=sum(p.numel() for p in autoencoder.network.parameters()),
        activations=activation_bytes(pixels=pixels, views=views, width=width),
        decoder=decoder_bytes(pixels=pixels, views=views),
        free=torch.cuda.mem_get_info(device)[0],
        can_quantize=find_spec("bitsandbytes") is not None,
    )


def _place(transformer: Any, placement: Placement, device: torch.device, dtype: torch.dtype) -> str | None:
    """Move the transformer; a sentence for the user where the precision has more to say."""
    if placement.precision == "offload":
        transformer.enable_group_offload(device, offload_type="block_level", num_blocks_per_group=1, use_stream=True)
        return None
    sentence = None
    if placement.precision == "fp8" and multiplies_in_eight_bits(device):
        sentence = f"fp8: {use_eight_bits(transformer)} layers multiply in 8 bits, with a scale for each row"
    elif placement.precision == "fp8":
        transformer.enable_layerwise_casting(storage_dtype=torch.float8_e4m3fn, compute_dtype=dtype)
        sentence = f"fp8: weights are only stored in 8 bits and computed in {dtype}: no torch._scaled_mm on {device}"
    if placement.precision != "nf4":
        transformer.to(device)
    return sentence
