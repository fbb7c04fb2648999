"""Tensor names and shapes of .safetensors files from their headers, with a check that the files are complete."""

import json
from collections.abc import Mapping
from pathlib import Path

_LARGEST_HEADER = 100_000_000


def read_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Read the shape of each tensor in the file.

    Raises:
        ValueError: the file is missing, truncated or of another format.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            length = int.from_bytes(stream.read(8), "little")
            if size < 8 or length > min(size - 8, _LARGEST_HEADER):
                raise ValueError(f"{size} bytes with a header of {length}")
            header = json.loads(stream.read(length))
        header.pop("__metadata__", None)
        end = 8 + length + max((entry["data_offsets"][1] for entry in header.values()), default=0)
        shapes = {name: tuple(entry["shape"]) for name, entry in header.items()}
    except OSError as error:
        raise ValueError(f"{path}: expected a .safetensors file, found {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"{path}: expected a .safetensors file, found {' '.join(str(error).split())[:120]}") from error
    if end != size:
        raise ValueError(f"{path}: expected {end} bytes by its header, found {size}; is the download complete?")
    return shapes


def read_model_shapes(folder: Path, stem: str, variant: str = "") -> Mapping[str, tuple[int, ...]]:
    """Read the shapes of all tensors of a model.

    Args:
        folder: where the files are.
        stem: of the file names; with STEM.safetensors.index.json the model is split over several files.
        variant: as in STEM.VARIANT.safetensors and STEM.safetensors.index.VARIANT.json; empty for plain names.

    Raises:
        ValueError: a file is missing, truncated or broken.
    """
    middle = f".{variant}" if variant else ""
    listing = folder / f"{stem}.safetensors.index{middle}.json"
    if listing.is_file():
        try:
            names = sorted(set(json.loads(listing.read_text())["weight_map"].values()))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{listing}: expected a weight_map, found {type(error).__name__}: {error}") from error
    else:
        names = [f"{stem}{middle}.safetensors"]
    shapes: dict[str, tuple[int, ...]] = {}
    for name in names:
        shapes |= read_shapes(folder / name)
    return shapes
