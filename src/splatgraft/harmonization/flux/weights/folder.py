"""Folders of FLUX harmonisers: finds their parts, reads the variant and checks shapes without loading weights.

    transformer/config.json, diffusion_pytorch_model*.safetensors   (or these in the folder itself; also .bf16.)
    vae/  empty_prompt.safetensors  harmonizer.json                 (the base's where a folder has none)

harmonizer.json is written by this package: {"variant": "image-mask"}, and may name the "guidance" that a network made
of FLUX.1-dev was trained with. The authors' folders are named by their variant.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from splatgraft.harmonization.flux.baked_modulation import GUIDANCE
from splatgraft.harmonization.flux.empty_prompt import PROMPT_FILE
from splatgraft.harmonization.flux.weights.safetensors_header import read_model_shapes
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.weights.catalogue import ModelWeights
from splatgraft.runtime.weights.hub import fetch
from splatgraft.runtime.weights.layout import variant_in
from splatgraft.runtime.weights.store import folder_of, is_stored

Variant = Literal["image-mask", "image-background"]
"""The second condition beside the composite: the object's mask, or the scene without the object."""
VARIANTS: tuple[str, ...] = get_args(Variant)
CONDITIONS = 2
"""Images that condition the network: the composite and one more."""
DESCRIPTION_FILE = "harmonizer.json"
AUTHORS = "nviolante/dot3d"
WEIGHTS = "diffusion_pytorch_model"
Say = Callable[[str], None]


def local_folder(weights: str, say: Say, *, parts: Sequence[str] = ("transformer",)) -> Path:
    """Resolve `weights` to a local folder; what a hub id needs is fetched once (`splatgraft weights`).

    Args:
        weights: a folder, or a hub id OWNER/NAME or OWNER/NAME/FOLDER.
        say: receives the repository, its licence and the size before a download.
        parts: folders of the model that are needed; vae/ is taken too where it is there.

    Raises:
        ValueError: it is neither, or the download fails.
    """
    folder = Path(weights)
    if folder.is_dir():
        return folder
    names = weights.split("/")
    if folder.exists() or folder.is_absolute() or weights.startswith(".") or len(names) not in (2, 3) or not all(names):
        raise ValueError(
            f"{weights}: expected a folder with transformer/ or a hub id such as {AUTHORS}/image-mask, found "
            f"{'a file' if folder.exists() else 'none'}"
        )
    repository, inner = "/".join(names[:2]), "".join(names[2:])
    if repository == AUTHORS and not inner:
        inner = "image-mask"
    there = folder_of(repository)
    wanted = ModelWeights(weights, "named by its id", repository, folder=inner, parts=tuple(parts), optional=("vae",))
    if not is_stored(there, wanted):
        fetch(wanted, there, say=say)
    return there / inner


@dataclass(frozen=True)
class FluxFolder:
    """A model folder with a FLUX transformer whose files were checked."""

    folder: Path
    """The model folder."""
    transformer: Path
    """Where the transformer's config.json is."""
    config: dict[str, Any]
    """The transformer's config.json."""
    inputs: int
    """Latents that the first layer takes: 1 for FLUX itself, 3 for a harmoniser."""

    @staticmethod
    def open(folder: Path) -> "FluxFolder":
        """Check that the folder's files are complete and have the shapes of its config.

        Raises:
            ValueError: a file is missing or truncated, or its shapes do not match.
        """
        below = folder / "transformer"
        transformer = below if (below / "config.json").is_file() else folder
        config = read_config(transformer / "config.json", "FluxTransformer2DModel")
        shapes = read_model_shapes(transformer, WEIGHTS, weights_variant(transformer) or "")
        first, last = shapes.get("x_embedder.weight"), shapes.get("proj_out.weight")
        if first is None or last is None:
            raise ValueError(f"{transformer}: expected x_embedder.weight and proj_out.weight, found {_few(shapes)}")
        # diffusers' defaults, which a config may leave out
        inner = config.get("num_attention_heads", 24) * config.get("attention_head_dim", 128)
        configured = (inner, config.get("in_channels", 64))
        if first != configured:
            raise ValueError(
                f"{transformer}: expected x_embedder.weight of {_by(configured)} by config.json, found {_by(first)}"
            )
        out = last[0]
        if first[1] not in (out, out * (CONDITIONS + 1)):
            raise ValueError(
                f"{transformer}: expected x_embedder.weight of {inner} x {out} (FLUX) or {inner} x "
                f"{out * (CONDITIONS + 1)} (a harmoniser), found {_by(first)}"
            )
        return FluxFolder(folder, transformer, config, first[1] // out)

    @property
    def guidance(self) -> float | None:
        """Guidance that a guidance-distilled network (FLUX.1-dev) is told; None for networks without.

        Raises:
            ValueError: harmonizer.json is broken.
        """
        if not self.config.get("guidance_embeds", False):
            return None
        found = _description(self.folder).get("guidance", GUIDANCE)
        if not isinstance(found, int | float):
            raise ValueError(f"{self.folder / DESCRIPTION_FILE}: expected a number as guidance, found {found!r}")
        return float(found)

    def variant(self, requested: str) -> Variant:
        """Determine the variant: `requested`, or for `auto` that of harmonizer.json or of the folder's name.

        Raises:
            ValueError: it cannot be determined, contradicts `requested`, or the folder is FLUX itself.
        """
        if self.inputs != CONDITIONS + 1:
            width = self.config.get("in_channels", 64)
            raise ValueError(
                f"{self.transformer}: expected a first layer of {width * (CONDITIONS + 1)} channels, found {width}: "
                "FLUX itself, no harmoniser; train one by `splatgraft train flux` or give --lora"
            )
        names = (self.folder.name, self.folder.resolve().name, self.transformer.resolve().parent.name)
        declared = declared_variant(self.folder) or next((name for name in names if name in VARIANTS), None)
        if requested != "auto" and declared not in (None, requested):
            raise ValueError(f"{self.folder}: expected {requested} (--variant), found {declared}")
        chosen = declared if requested == "auto" else requested
        if chosen not in VARIANTS:
            raise ValueError(
                f"{self.folder}: expected {DESCRIPTION_FILE} or a folder called {' or '.join(VARIANTS)}, found "
                "neither; choose by --variant"
            )
        return chosen  # pyright: ignore


def weights_variant(folder: Path) -> str | None:
    """The variant of a model's weight files, `bf16` for *.bf16.safetensors; None for plain ones."""
    return variant_in([path.name for path in folder.iterdir()] if folder.is_dir() else []) or None


def declared_variant(folder: Path) -> str | None:
    """Read the variant from harmonizer.json in `folder`; None where there is no such file.

    Raises:
        ValueError: the file is broken.
    """
    path = folder / DESCRIPTION_FILE
    if not path.is_file():
        return None
    description = _description(folder)
    if "variant" not in description:
        raise ValueError(f"{path}: expected a variant, found {_few(description)}")
    variant = description["variant"]
    if variant not in VARIANTS:
        raise ValueError(f"{path}: expected variant {' or '.join(VARIANTS)}, found {variant}")
    return variant


def _description(folder: Path) -> dict[str, Any]:
    """The content of harmonizer.json; empty where there is no such file."""
    path = folder / DESCRIPTION_FILE
    try:
        found = json.loads(path.read_text()) if path.is_file() else {}
    except ValueError as error:
        raise ValueError(f"{path}: expected a variant, found {type(error).__name__}: {error}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path}: expected a variant, found a {type(found).__name__}")
    return found


def find_part(name: str, *folders: Path) -> Path:
    """Find `name` in the first of `folders` that has it.

    Raises:
        ValueError: none has it.
    """
    for folder in folders:
        if (folder / name).exists():
            return folder / name
    if name == PROMPT_FILE:
        return folders[0] / name  # read_prompt names the command that makes it
    raise ValueError(f"{folders[0]}: expected {name}/ here or in the --base, found neither")


def read_config(path: Path, kind: str) -> dict[str, Any]:
    """Read the diffusers config of a model of class `kind`.

    Raises:
        ValueError: it is missing, broken or of another class.
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


def write_description(folder: Path, about: dict[str, Any]) -> None:
    """Write harmonizer.json."""
    with atomic_write(folder / DESCRIPTION_FILE) as stream:
        stream.write((json.dumps(about, indent=1) + "\n").encode())


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))


def _few(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)[:3]) or "nothing"
