"""The optional parts: what each is for and which modules it brings. Imports none of them."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Extra:
    """One optional part of the package, installed by `pip install 'splatgraft[name]'`."""

    purpose: str
    """What it adds."""
    packages: Mapping[str, str]
    """Module to the package that brings it."""


EXTRAS = {
    "cuda": Extra("splatting kernels for NVIDIA GPUs", {"gsplat": "gsplat", "packaging": "packaging"}),
    "sfm": Extra("poses for photos and videos that have none", {"pycolmap": "pycolmap"}),
    "flux": Extra(
        "the paper's image model and its training",
        {"diffusers": "diffusers", "accelerate": "accelerate"},
    ),
    "text": Extra("text encoders, to embed the empty prompt once", {"transformers": "transformers"}),
    "blender": Extra("made-up scenes with ground truth", {"bpy": "bpy"}),
    "ray": Extra("rendering and evaluating on many machines", {"ray": "ray"}),
    "birefnet": Extra(
        "object masks from a network", {"onnxruntime": "onnxruntime", "huggingface_hub": "huggingface_hub"}
    ),
}


def extra_of(module: str) -> str | None:
    """The extra that brings `module`, or None."""
    top = module.split(".", maxsplit=1)[0]
    return next((name for name, extra in EXTRAS.items() if top in extra.packages), None)
