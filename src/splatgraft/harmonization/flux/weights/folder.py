"""Folders of FLUX harmonisers: where the parts are, which variant it is, what does not fit. Loads no weights.

    transformer/config.json, diffusion_pytorch_model*.safetensors   (or these in the folder itself)
    vae/  empty_prompt.safetensors  harmonizer.json                 (the base's where a folder has none)

harmonizer.json is ours: {"variant": "image-mask"}. The authors' folders are called image-mask and image-background.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from splatgraft.harmonization.flux.empty_prompt import PROMPT_FILE
from splatgraft.harmonization.flux.weights.library import download, licence_of
from splatgraft.harmonization.flux.weights.safetensors_header import shapes_in
from splatgraft.runtime.atomic_file import atomic_write

Variant = Literal["image-mask", "image-background"]
"""What joins the composite: the object's mask, or the scene without the object."""
VARIANTS: tuple[str, ...] = get_args(Variant)
CONDITIONS = 2
"""Pictures that join the noisy latent: the composite and one more."""
ABOUT_FILE = "harmonizer.json"
AUTHORS = "nviolante/dot3d"
WEIGHTS = "diffusion_pytorch_model"
_PARTS = ("", "transformer/", "vae/", "unet/")
_HUB_PATTERNS = [
    # neither single files of the whole nor half-precision copies nor text encoders, which would double a download
    *(
        f"{part}{name}"
        for part in _PARTS
        for name in ("config.json", f"{WEIGHTS}.safetensors*", f"{WEIGHTS}-*.safetensors")
    ),
    *("model_index.json", ABOUT_FILE, PROMPT_FILE),
]

Say = Callable[[str], None]


def local_folder(weights: str, say: Say) -> Path:
    """The folder `weights`, or the hub repository of that name (and a folder in it), downloaded once.

    Raises: ValueError where it is neither.
    """
    folder = Path(weights)
    if folder.is_dir():
        return folder
    parts = weights.split("/")
    if folder.exists() or folder.is_absolute() or weights.startswith(".") or len(parts) not in (2, 3) or not all(parts):
        raise ValueError(
            f"{weights}: expected a folder with transformer/ or a hub id such as {AUTHORS}/image-mask, found "
            f"{'a file' if folder.exists() else 'none'}"
        )
    repository, inner = "/".join(parts[:2]), "".join(parts[2:])
    say(f"weights: {repository} from the Hugging Face hub; licence: {licence_of(repository)}, read it before use")
    if repository == AUTHORS and not inner:
        inner = "image-mask"
    patterns = [f"{inner}/{pattern}" for pattern in _HUB_PATTERNS] if inner else _HUB_PATTERNS
    return download(repository, patterns) / inner


@dataclass(frozen=True)
class FluxFolder:
    """A checked folder with a FLUX transformer."""

    folder: Path
    """The whole."""
    transformer: Path
    """Where the transformer's config.json is."""
    config: dict[str, Any]
    """Of the transformer."""
    inputs: int
    """Pictures that the first layer takes: 1 for FLUX itself, 3 for a harmoniser."""

    @staticmethod
    def open(folder: Path) -> "FluxFolder":
        """The folder, its files found whole and of the shapes that its config says.

        Raises: ValueError where something is missing, truncated or of other shapes.
        """
        below = folder / "transformer"
        transformer = below if (below / "config.json").is_file() else folder
        config = read_config(transformer / "config.json", "FluxTransformer2DModel")
        shapes = shapes_in(transformer, WEIGHTS)
        first, last = shapes.get("x_embedder.weight"), shapes.get("proj_out.weight")
        if first is None or last is None:
            raise ValueError(f"{transformer}: expected x_embedder.weight and proj_out.weight, found {_few(shapes)}")
        # diffusers' defaults, which a config may leave out
        inner = config.get("num_attention_heads", 24) * config.get("attention_head_dim", 128)
        told = (inner, config.get("in_channels", 64))
        if first != told:
            raise ValueError(
                f"{transformer}: expected x_embedder.weight of {_by(told)} by config.json, found {_by(first)}"
            )
        out = last[0]
        if first[1] not in (out, out * (CONDITIONS + 1)):
            raise ValueError(
                f"{transformer}: expected x_embedder.weight of {inner} x {out} (FLUX) or {inner} x "
                f"{out * (CONDITIONS + 1)} (a harmoniser), found {_by(first)}"
            )
        return FluxFolder(folder, transformer, config, first[1] // out)

    def variant(self, wanted: str) -> Variant:
        """What joins the composite: `wanted`, or by harmonizer.json or the folder's name where that is `auto`.

        Raises: ValueError where it cannot be told or contradicts `wanted`.
        """
        if self.inputs != CONDITIONS + 1:
            width = self.config.get("in_channels", 64)
            raise ValueError(
                f"{self.transformer}: expected a first layer of {width * (CONDITIONS + 1)} channels, found {width}: "
                "FLUX itself, no harmoniser; `splatgraft train flux` makes one of it, --lora adapts it"
            )
        names = (self.folder.name, self.folder.resolve().name, self.transformer.resolve().parent.name)
        told = variant_told(self.folder) or next((name for name in names if name in VARIANTS), None)
        if wanted != "auto" and told not in (None, wanted):
            raise ValueError(f"{self.folder}: expected {wanted} (--variant), found {told}")
        chosen = told if wanted == "auto" else wanted
        if chosen not in VARIANTS:
            raise ValueError(
                f"{self.folder}: expected {ABOUT_FILE} or a folder called {' or '.join(VARIANTS)}, found neither; "
                "say which by --variant"
            )
        return chosen  # pyright: ignore


def variant_told(folder: Path) -> str | None:
    """The variant that harmonizer.json in `folder` names; None where there is no such file.

    Raises: ValueError where the file is broken.
    """
    path = folder / ABOUT_FILE
    if not path.is_file():
        return None
    try:
        told = json.loads(path.read_text())["variant"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected a variant, found {type(error).__name__}: {error}") from error
    if told not in VARIANTS:
        raise ValueError(f"{path}: expected variant {' or '.join(VARIANTS)}, found {told}")
    return told


def part(name: str, *folders: Path) -> Path:
    """The first of the folders' `name` that is there.

    Raises: ValueError where none has it.
    """
    for folder in folders:
        if (folder / name).exists():
            return folder / name
    if name == PROMPT_FILE:
        return folders[0] / name  # its reader says how it is made
    raise ValueError(f"{folders[0]}: expected {name}/ here or in the --base, found neither")


def read_config(path: Path, kind: str) -> dict[str, Any]:
    """A diffusers config of the class `kind`.

    Raises: ValueError where it is missing, broken or of another class.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected the config of a {kind}, found none")
    try:
        config = json.loads(path.read_text())
        found = config.get("_class_name")
    except (ValueError, AttributeError) as error:
        raise ValueError(f"{path}: expected the config of a {kind}, found {error}") from error
    if found != kind:
        raise ValueError(f"{path}: expected _class_name {kind}, found {found}")
    return config


def write_about(folder: Path, about: dict[str, Any]) -> None:
    """Write harmonizer.json."""
    with atomic_write(folder / ABOUT_FILE) as stream:
        stream.write((json.dumps(about, indent=1) + "\n").encode())


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))


def _few(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)[:3]) or "nothing"
