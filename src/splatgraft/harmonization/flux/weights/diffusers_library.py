"""Classes of the diffusers library, imported on first use (the only module that imports diffusers)."""

from pathlib import Path
from typing import Any

_INPUT_AND_OUTPUT_LAYERS = ("x_embedder", "context_embedder", "proj_out")


def _diffusers() -> Any:
    import diffusers

    diffusers.utils.logging.set_verbosity_error()  # errors are reported by this package
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


def dpm_solver_class() -> Any:
    """`DPMSolverMultistepScheduler`."""
    return _diffusers().DPMSolverMultistepScheduler


def nf4_config(compute_dtype: Any) -> Any:
    """Configuration of 4-bit NormalFloat weights; loading a model with it needs bitsandbytes."""
    return _diffusers().BitsAndBytesConfig(
        load_in_4bit=True,
        bnb_4bit_quant_type="nf4",
        bnb_4bit_compute_dtype=compute_dtype,
        llm_int8_skip_modules=[
            "norm",
            "norm1",
            "norm1_context",
            "norm_out",
            "time_text_embed",
            *_INPUT_AND_OUTPUT_LAYERS,
        ],
    )


def text_to_image_pipeline(base: str, **settings: Any) -> Any:
    """Load the stock FLUX pipeline with its text encoders; needs transformers too.

    Raises:
        ValueError: `base` is no such pipeline.
    """
    try:
        return _diffusers().FluxPipeline.from_pretrained(base, **settings)
    except OSError as error:
        raise ValueError(f"{base}: expected a FLUX pipeline with its text encoders, found {one_line(error)}") from error


def flux_lora_names(path: Path, tensors: dict[str, Any]) -> dict[str, Any]:
    """Rename the tensors of a low-rank adaptation by another program to diffusers' names; scales are applied.

    Raises:
        ValueError: diffusers does not know these names.
    """
    _diffusers()
    from diffusers.loaders.lora_pipeline import FluxLoraLoaderMixin

    try:
        return FluxLoraLoaderMixin.lora_state_dict(dict(tensors))  # pyright: ignore
    except Exception as error:  # the converters fail with KeyError, ValueError, NotImplementedError and more
        found = one_line(error)
        raise ValueError(f"{path}: expected tensor names that diffusers can convert, found {found}") from error


def one_line(error: Exception) -> str:
    """Type and message of an error in one line; the message is cut at 200 characters."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
