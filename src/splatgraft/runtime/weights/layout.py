"""Which files of a hub repository are needed: one set of weights for each part of a diffusers model, or named files.

Repositories hold the same weights several times: in 16 and 32 bits, in one file and in shards, for other programs. Of a
part of a diffusers model this takes config.json and one set, in 16 bits where there is one, as .safetensors.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from splatgraft.runtime.weights.catalogue import ModelWeights

_STEMS = ("diffusion_pytorch_model", "model")
"""File stems of diffusers' and of transformers' weights."""
_VARIANTS = ("bf16", "", "fp16")
"""In the order of preference. fp16 is last: FLUX overflows in it."""
_BESIDE = ("harmonizer.json", "empty_prompt.safetensors", "model_index.json")
"""Small files that are taken where they are."""


@dataclass(frozen=True)
class HubFile:
    """One file of a repository."""

    path: str
    """Inside the repository, with slashes."""
    size: int
    """Bytes."""
    sha256: str | None = None
    """Of the content; None for small files, whose hash the hub does not give."""


def needed_files(listing: Sequence[HubFile], model: ModelWeights) -> list[HubFile]:
    """Choose the files of a repository that a model needs.

    Args:
        listing: All files of the repository.
        model: What is needed. A part is looked for in the model's folder, then at the root of the repository; the
            model's folder may itself be the transformer.

    Raises:
        ValueError: A part or file is not there.
    """
    if not model.parts:
        found = [file for file in listing if any(fnmatchcase(file.path, pattern) for pattern in model.files)]
        if not found:
            raise ValueError(f"{model.repository}: expected {', '.join(model.files)}, found {_few(listing)}")
        return found
    inner = f"{model.folder}/" if model.folder else ""
    beside = {f"{prefix}{name}" for name in _BESIDE for prefix in (inner, "")}
    chosen = [file for file in listing if file.path in beside]
    for part in (*model.parts, *model.optional):
        places = [f"{inner}{part}/", f"{part}/", *([inner] if part == "transformer" else [])]
        taken = next((files for place in dict.fromkeys(places) if (files := _part(listing, place))), None)
        if taken is None and part in model.parts:
            where = f"{model.repository}/{model.folder}".rstrip("/")
            raise ValueError(f"{where}: expected {part}/ with .safetensors weights, found {_few(listing)}")
        chosen += taken or []
    return list(dict.fromkeys(chosen))


def _part(listing: Sequence[HubFile], place: str) -> list[HubFile]:
    """The files of the part in the folder `place`, empty where it is none."""
    here = {file.path.removeprefix(place): file for file in listing if file.path.startswith(place)}
    here = {name: file for name, file in here.items() if "/" not in name}
    if place.rstrip("/").endswith(("tokenizer", "tokenizer_2")):
        return [file for name, file in here.items() if name.endswith((".json", ".txt", ".model"))]
    if "config.json" not in here:
        return []
    for stem in _STEMS:
        for variant in _VARIANTS:
            names = weight_names(list(here), stem, variant)
            if names:
                return [here["config.json"], *(here[name] for name in names)]
    return []


def weight_names(names: Sequence[str], stem: str, variant: str) -> list[str]:
    """The names of one set of weights among `names`, shards with their index; empty where it is not there.

    Args:
        names: File names in one folder.
        stem: `diffusion_pytorch_model` or `model`.
        variant: `bf16`, `fp16`, or empty for the plain files.
    """
    full = f"{stem}.{variant}" if variant else stem
    if f"{full}.safetensors" in names:
        return [f"{full}.safetensors"]
    index = f"{stem}.safetensors.index.{variant}.json" if variant else f"{stem}.safetensors.index.json"
    shards = sorted(name for name in names if fnmatchcase(name, f"{full}-?????-of-?????.safetensors"))
    return [index, *shards] if index in names and shards else []


def variant_in(names: Sequence[str], stem: str = _STEMS[0]) -> str:
    """The variant that is loaded from a folder with these files; empty for the plain one, also where there is none."""
    return next((variant for variant in _VARIANTS if weight_names(names, stem, variant)), "")


def _few(listing: Sequence[HubFile]) -> str:
    names = sorted({file.path.split("/", maxsplit=1)[0] for file in listing})
    return ", ".join(names[:8]) + (" ..." if len(names) > 8 else "") or "no files"
