"""The only importer of diffusers and safetensors in harmonize, when one of its classes is wanted. Knows no model."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from splatgraft.runtime.atomic_file import atomic_write

_ENDS = ("x_embedder", "context_embedder", "proj_out")


def _diffusers() -> Any:
    import diffusers

    diffusers.utils.logging.set_verbosity_error()  # what matters is said in our own words
    return diffusers


def flux_transformer_class() -> Any:
    """`FluxTransformer2DModel`."""
    return _diffusers().FluxTransformer2DModel


def autoencoder_class() -> Any:
    """`AutoencoderKL`."""
    return _diffusers().AutoencoderKL


def unet_class() -> Any:
    """`UNet2DConditionModel`."""
    return _diffusers().UNet2DConditionModel


def nf4_config(compute_dtype: Any) -> Any:
    """The quantisation of weights to 4-bit NormalFloat; bitsandbytes is needed when a model is loaded with it."""
    return _diffusers().BitsAndBytesConfig(
        load_in_4bit=True,
        bnb_4bit_quant_type="nf4",
        bnb_4bit_compute_dtype=compute_dtype,
        llm_int8_skip_modules=["norm", "norm1", "norm1_context", "norm_out", "time_text_embed", *_ENDS],
    )


def text_to_image_pipeline(base: str, **settings: Any) -> Any:
    """The stock FLUX pipeline with its text encoders; needs transformers too.

    Raises: ValueError where `base` is no such pipeline.
    """
    try:
        return _diffusers().FluxPipeline.from_pretrained(base, **settings)
    except OSError as error:
        raise ValueError(f"{base}: expected a FLUX pipeline with its text encoders, found {_line(error)}") from error


def download(repository: str, patterns: list[str]) -> Path:
    """A copy of those files of a hub repository, downloaded once.

    Raises: ValueError where that fails.
    """
    import huggingface_hub

    try:
        return Path(huggingface_hub.snapshot_download(repository, allow_patterns=patterns))
    except Exception as error:  # network, missing repository, gated licence: all are the user's to mend
        raise ValueError(
            f"{repository}: expected a folder here or a repository on the Hugging Face hub that can be downloaded, "
            f"found {_line(error)}"
        ) from error


def licence_of(repository: str) -> str:
    """The licence that a hub repository names; `unknown` where it cannot be asked or does not say."""
    import huggingface_hub

    try:
        card = huggingface_hub.model_info(repository).card_data
    except Exception:  # a missing card or no network must not stop what is already downloaded
        return "unknown"
    return str(getattr(card, "license", None) or "unknown")


def read_tensors(path: Path) -> dict[str, Tensor]:
    """All tensors of a .safetensors file.

    Raises: ValueError where it is missing, truncated or no such file.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise ValueError(f"{path}: expected a whole .safetensors file, found {_line(error)}") from error


def write_tensors(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, str] | None = None) -> None:
    """Write a .safetensors file, whole or not at all; `about` goes into its metadata, as JSON."""
    from safetensors.torch import save

    # one key: safetensors writes several in an order that differs from run to run
    told = {"splatgraft": json.dumps(dict(about), sort_keys=True)} if about else None
    content = save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, told)
    with atomic_write(path) as stream:
        stream.write(content)


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
