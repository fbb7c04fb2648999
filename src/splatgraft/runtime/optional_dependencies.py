"""The optional dependencies of the package: purpose, modules and the extra that installs them."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class OptionalDependency:
    """One extra of the package, installed by `pip install 'splatgraft[name]'`."""

    purpose: str
    """Purpose of the extra, for `doctor`."""
    packages: Mapping[str, str]
    """Package that provides each module, by the module's name."""


OPTIONAL_DEPENDENCIES = {
    "cuda": OptionalDependency("splatting kernels for NVIDIA GPUs", {"gsplat": "gsplat", "packaging": "packaging"}),
    "sfm": OptionalDependency("poses for photos and videos that have none", {"pycolmap": "pycolmap"}),
    "heic": OptionalDependency("photos in HEIC, as iPhones write them", {"pillow_heif": "pillow-heif"}),
    "spz": OptionalDependency(".spz scenes of version 4", {"zstandard": "zstandard"}),
    "flux": OptionalDependency(
        "the paper's image model and its training",
        {"diffusers": "diffusers", "accelerate": "accelerate", "peft": "peft", "safetensors": "safetensors"},
    ),
    "text": OptionalDependency("text encoders, to embed the empty prompt once", {"transformers": "transformers"}),
    "blender": OptionalDependency("synthetic scenes with ground truth", {"bpy": "bpy"}),
    "ray": OptionalDependency("rendering and evaluating on many machines", {"ray": "ray"}),
    "birefnet": OptionalDependency(
        "object masks from a network", {"onnxruntime": "onnxruntime", "huggingface_hub": "huggingface_hub"}
    ),
}


def extra_providing(module: str) -> str | None:
    """Return the name of the extra that installs `module`, or None."""
    top = module.split(".", maxsplit=1)[0]
    return next((name for name, extra in OPTIONAL_DEPENDENCIES.items() if top in extra.packages), None)
