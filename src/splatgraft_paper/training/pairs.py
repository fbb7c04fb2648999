"""Training pairs on disk, and deterministic mixtures of several folders of pairs.

Seed and position determine the pair at a position of a mixture, so that a run can be resumed anywhere. There are two
kinds of folders (paper, Sec. 5.2): rendered pairs (`paper synth pairs`), described in `synthesis/pairs.py`, and relit
ones (`paper synth generated`, `orida` and `spheres`):

    manifest.jsonl                 one line per sample: folder, group, relit (number of lights), provenance
    NAME/target.png  background.png  mask.png  relit_0.png ..  record.json
"""

import hashlib
import json
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import read_mask, read_rgb, read_straight_rgb, resize, write_image
from splatgraft.runtime.files import atomic_folder, atomic_write
from splatgraft_paper.synthesis.jobs import parse_image_size
from splatgraft_paper.synthesis.pairs import composite, match_statistics, read_manifest
from splatgraft_paper.training.recipes import Recipe

Role = Literal["composite", "target", "background", "mask"]
MANIFEST_FILE = "manifest.jsonl"
RECORD_FILE = "record.json"
SPLIT_FILE = "split.json"
"""File beside a model's weights that names the groups of pairs it was trained on, and those held out."""


@dataclass(frozen=True)
class TrainingPair:
    """One training pair, sRGB in [0, 1]."""

    composite: Float[Tensor, "h w 3"]
    """Object under another light, pasted onto the background (paper, Eq. 2)."""
    target: Float[Tensor, "h w 3"]
    """Object in the scene."""
    background: Float[Tensor, "h w 3"]
    """Scene without the object."""
    mask: Float[Tensor, "h w"]
    """Coverage of each pixel by the object, in [0, 1]."""

    def picture(self, role: str) -> Float[Tensor, "h w 3"]:
        """Return the image of a role; the mask is binary, with three equal channels, as networks expect it."""
        if role == "mask":
            return (self.mask > 0.5).float()[..., None].expand(-1, -1, 3)
        return getattr(self, role)


def crop_to_size(image: Float[Tensor, "h w *c"], width: int, height: int) -> Float[Tensor, "{height} {width} *c"]:
    """Resize an image to cover `width` x `height` pixels, then crop it to its centre."""
    h, w = image.shape[:2]
    scale = max(width / w, height / h)
    larger = resize(image, max(width, round(w * scale)), max(height, round(h * scale)))
    top, left = (larger.shape[0] - height) // 2, (larger.shape[1] - width) // 2
    return larger[top : top + height, left : left + width]


def crop_pair_to_size(pair: TrainingPair, width: int, height: int) -> TrainingPair:
    """Resize and crop all images of a pair (see `crop_to_size`)."""
    images = (crop_to_size(image, width, height) for image in (pair.composite, pair.target, pair.background, pair.mask))
    return TrainingPair(*(torch.clamp(image, 0, 1) for image in images))


@dataclass(frozen=True)
class PairFiles:
    """Files of one pair."""

    group: str
    """Scene, photo or object of the pair; groups are held out as a whole."""
    target: Path
    background: Path
    mask: Path
    relit: Path
    """Object under another light."""

    def files(self, role: Role) -> tuple[Path, ...]:
        """List the files from which the image of a role is made."""
        if role == "composite":
            return (self.relit, self.target, self.background, self.mask)
        return (getattr(self, role),)

    def key(self, role: Role) -> str:
        """Return a key of the image of a role, from the paths, sizes and times of its files."""
        found = [role]
        for path in self.files(role):
            try:
                status = path.stat()
            except OSError as error:
                raise ValueError(f"{path}: expected a picture of a pair, found {error.strerror}") from error
            found.append(f"{path.resolve()}|{status.st_size}|{status.st_mtime_ns}")
        return "|".join(found)

    def read(self) -> TrainingPair:
        """Read the pair; its composite has the relit object at the exposure of the one in the scene (paper, Eq. 2)."""
        target, background = read_rgb(self.target), read_rgb(self.background)
        mask, relit = read_mask(self.mask), read_straight_rgb(self.relit)
        for path, picture in ((self.background, background), (self.mask, mask), (self.relit, relit)):
            if picture.shape[:2] != target.shape[:2]:
                expected, found = (f"{size[1]}x{size[0]}" for size in (target.shape, picture.shape))
                raise ValueError(f"{path}: expected {expected} pixels as {self.target.name}, found {found}")
        return TrainingPair(
            composite(match_statistics(relit, target, mask), background, mask), target, background, mask
        )


@dataclass(frozen=True)
class PairFolder:
    """All pairs of one folder."""

    name: str
    """Path of the folder, which is part of a training's fingerprint."""
    pairs: tuple[PairFiles, ...]

    @property
    def groups(self) -> frozenset[str]:
        """Groups of all pairs."""
        return frozenset(pair.group for pair in self.pairs)


def open_source(option: str, folders: Sequence[str]) -> list[PairFolder]:
    """Open the folders of one source, which its option names: pairs, generated or orida."""
    return [open_rendered(Path(folder)) if option == "pairs" else open_relit(Path(folder)) for folder in folders]


def open_rendered(folder: Path) -> PairFolder:
    """List the pairs that `paper synth pairs` rendered."""
    pairs = [
        PairFiles(
            sample.folder.name,
            target=sample.path(sample.object),
            background=sample.path("background"),
            mask=sample.path(sample.object, "mask"),
            relit=sample.path(f"{sample.object}_{sample.light}"),
        )
        for sample in read_manifest(folder)
    ]
    return PairFolder(str(folder), tuple(pairs))


def open_relit(folder: Path) -> PairFolder:
    """List the pairs of a folder of relit samples, one per sample and light."""
    path = folder / MANIFEST_FILE
    if not path.is_file():
        raise ValueError(
            f"{path}: expected the manifest of generated pairs, found none (splatgraft paper synth generated)"
        )
    pairs: list[PairFiles] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            entry = json.loads(line)
            inside = folder / entry["folder"]
            files = (inside / "target.png", inside / "background.png", inside / "mask.png")
            pairs += [
                PairFiles(str(entry["group"]), *files, inside / f"relit_{light}.png")
                for light in range(int(entry["relit"]))
            ]
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}, line {number}: expected folder, group and relit, found {line[:80]}") from error
    return PairFolder(str(folder), tuple(pairs))


@dataclass(frozen=True)
class RelitSample:
    """One target with its background and relit images."""

    target: Float[Tensor, "h w 3"]
    background: Float[Tensor, "h w 3"]
    mask: Float[Tensor, "h w"]
    relit: Sequence[Float[Tensor, "h w 3"]] = ()
    """Whole target under other lights, one image per light."""


def write_sample(folder: Path, sample: RelitSample, record: Mapping[str, Any]) -> None:
    """Write one relit sample atomically; `record` holds group, licence and provenance of each image."""
    with atomic_folder(folder) as new:
        write_image(new / "target.png", sample.target)
        write_image(new / "background.png", sample.background)
        write_image(new / "mask.png", sample.mask)
        for i, picture in enumerate(sample.relit):
            write_image(new / f"relit_{i}.png", picture)
        (new / RECORD_FILE).write_text(
            json.dumps({**record, "relit": len(sample.relit)}, indent=1) + "\n", encoding="utf-8"
        )


def write_relit_manifest(out: Path) -> int:
    """Write one line per complete sample, and return their number."""
    lines = [
        json.dumps({"folder": path.parent.name, **json.loads(path.read_text(encoding="utf-8"))})
        for path in sorted(out.glob(f"*/{RECORD_FILE}"))
    ]
    with atomic_write(out / MANIFEST_FILE) as stream:
        stream.write("".join(f"{line}\n" for line in lines).encode())
    return len(lines)


@dataclass(frozen=True)
class Mixture:
    """Folders from which pairs are drawn by weight."""

    names: tuple[str, ...]
    weights: tuple[float, ...]
    """Relative weights, one per folder."""
    pairs: tuple[tuple[PairFiles, ...], ...]
    """Pairs of this mixture, by folder."""
    seed: int

    def draw(self, position: int) -> PairFiles:
        """Draw the pair at a position of the infinite sequence; seed and position determine it."""
        rng = random.Random(f"{self.seed}-{position}")
        return rng.choice(self.pairs[rng.choices(range(len(self.pairs)), self.weights)[0]])

    def all(self) -> list[PairFiles]:
        """List every pair once, alternating between folders."""
        numbered = [(i, pair) for own in self.pairs for i, pair in enumerate(own)]
        return [pair for _, pair in sorted(numbered, key=lambda entry: entry[0])]


def held_out_groups(folder: PairFolder, share: float) -> frozenset[str]:
    """Choose the groups of a folder that are held out, the first in the order of their names' hashes."""
    groups = sorted(folder.groups, key=lambda group: hashlib.sha256(group.encode()).hexdigest())
    count = max(1, round(share * len(groups))) if share > 0 and len(groups) > 1 else 0
    return frozenset(groups[:count])


def split_mixture(
    folders: Sequence[PairFolder], *, weights: Sequence[float], held_out: float, seed: int
) -> tuple[Mixture, Mixture | None]:
    """Split folders into training and held-out pairs, by whole groups in the order of their names' hashes.

    Args:
        folders: Folders of pairs.
        weights: Relative weights, one per folder.
        held_out: Share of the groups of each folder that is held out, at least one group; or 0.
        seed: Seed of the order of pairs.

    Returns:
        The training mixture, and the held-out mixture or None.
    """
    if not folders or not all(folder.pairs for folder in folders):
        empty = next((folder.name for folder in folders if not folder.pairs), "no source")
        raise ValueError(f"training data: expected pairs, found none in {empty}")
    if len(weights) != len(folders) or min(weights) < 0 or sum(weights) <= 0:
        raise ValueError(f"--weights: expected {len(folders)} numbers of at least 0, found {list(weights)}")
    training, validation = [], []
    for folder in folders:
        excluded = held_out_groups(folder, held_out)
        training.append(tuple(pair for pair in folder.pairs if pair.group not in excluded))
        validation.append(tuple(pair for pair in folder.pairs if pair.group in excluded))
    names, shares = tuple(folder.name for folder in folders), tuple(weights)
    train = Mixture(names, shares, tuple(training), seed)
    used = [i for i, pairs in enumerate(validation) if pairs]
    if not used:
        return train, None
    kept = (tuple(values[i] for i in used) for values in (names, shares, validation))
    return train, Mixture(*kept, seed)  # pyright: ignore


@dataclass(frozen=True)
class DataOptions:
    """Folders of pairs, their mixture and their size."""

    pairs: tuple[str, ...] = ()
    """Folders that `splatgraft paper synth pairs` rendered."""
    generated: tuple[str, ...] = ()
    """Folders that `splatgraft paper synth generated` or `synth spheres` made."""
    orida: tuple[str, ...] = ()
    """Folders that `splatgraft paper synth orida` made."""
    weights: tuple[float, ...] = ()
    """Relative frequency of each folder, in the order above; default: the recipe's, or the paper's."""
    size: str = "704x496"
    """Pixels of a training picture, WIDTHxHEIGHT, multiples of 16."""
    held_out: float = 0.05
    """Share of the scenes for validation, which are never trained on."""


Split = Mapping[str, Sequence[Mapping[str, Sequence[str]]]]
"""Names of the groups `trained` on and `held_out`, of each folder of a source, by the source's option."""


def write_split(folder: Path, split: Split) -> None:
    """Write which groups a training used and held out beside its weights."""
    with atomic_write(folder / SPLIT_FILE) as stream:
        stream.write((json.dumps(split, indent=1) + "\n").encode())


def read_split(folder: Path) -> Split | None:
    """Read the groups that a training used and held out; None without a record, as beside other authors' weights."""
    path = folder / SPLIT_FILE
    if not path.is_file():
        return None
    try:
        found: Split = json.loads(path.read_text(encoding="utf-8"))
        return {
            name: [{"trained": one["trained"], "held_out": one["held_out"]} for one in found[name]] for name in found
        }
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected the groups of a training, found {type(error).__name__}: {error}") from error


@dataclass(frozen=True)
class TrainingData:
    """Pairs of the opened folders, split by whole scenes."""

    mixture: Mixture
    held_out: Mixture | None
    """Held-out pairs; None without any."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    lines: tuple[str, ...] = ()
    """One line of text per folder: its number of training pairs, and its share of the drawn pairs."""
    split: "Split" = field(default_factory=dict)
    """Groups of each folder."""


def open_training_data(options: DataOptions, seed: int, recipe: Recipe | None) -> TrainingData:
    """Open the folders and hold out scenes.

    All sources of a recipe must be given, and its weights are the default. Without a recipe the default weights are the
    paper's, for the given sources.
    """
    width, height = parse_image_size(options.size, multiple_of=16)
    given = {"pairs": options.pairs, "generated": options.generated, "orida": options.orida}
    counts = {name: len(folders) for name, folders in given.items()}
    chosen = recipe or Recipe.read("paper").for_folders(counts)
    weights = options.weights or chosen.weights(counts)
    opened = {name: open_source(name, listed) for name, listed in given.items() if listed}
    folders = [folder for listed in opened.values() for folder in listed]
    if not folders:
        raise ValueError("training data: expected --pairs, --generated or --orida, found none")
    mixture, held_out = split_mixture(folders, weights=weights, held_out=options.held_out, seed=seed)
    lines = [
        f"data: {len(own)} pairs to train on, {len(folder.pairs) - len(own)} held out, {folder.name}; "
        f"{share / sum(weights):.0%} of the drawn pairs"
        for folder, own, share in zip(folders, mixture.pairs, weights, strict=True)
    ]
    split = {name: [_split_of(folder, options.held_out) for folder in listed] for name, listed in opened.items()}
    return TrainingData(mixture, held_out, width, height, tuple(lines), split)


def _split_of(folder: PairFolder, share: float) -> dict[str, list[str]]:
    held_out = held_out_groups(folder, share)
    return {"trained": sorted(folder.groups - held_out), "held_out": sorted(held_out)}
