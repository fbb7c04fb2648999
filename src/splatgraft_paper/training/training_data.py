"""The training data of `train flux` and `train removal`: options, sources and the split for validation."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splatgraft.workflow.image_size import parse_image_size
from splatgraft_paper.training.sources.packed_pairs import INDEX_FILE, PackedPairs
from splatgraft_paper.training.sources.pair_source import Mixture, PairSource, split_mixture
from splatgraft_paper.training.sources.relit_pairs import RelitPairs
from splatgraft_paper.training.sources.rendered_pairs import RenderedPairs
from splatgraft_paper.training.training_recipe import Recipe


@dataclass(frozen=True)
class DataOptions:
    """Folders of pairs, their mixture and their size."""

    pairs: tuple[str, ...] = ()
    """Folders that `splatgraft synth pairs` rendered; or, here and below, of `synth pack`: a folder or an address."""
    generated: tuple[str, ...] = ()
    """Folders that `splatgraft synth generated` or `synth spheres` made."""
    orida: tuple[str, ...] = ()
    """Folders that `splatgraft synth orida` made."""
    weights: tuple[float, ...] = ()
    """Relative frequency of each folder, in the order above; a recipe's, or the numbers of pairs, where not given."""
    size: str = "704x496"
    """Pixels of a training picture, WIDTHxHEIGHT, multiples of 16."""
    held_out: float = 0.05
    """Share of the scenes that are kept for validation and never trained on."""


@dataclass(frozen=True)
class TrainingData:
    """Opened sources, split by whole scenes."""

    mixture: Mixture
    held_out: Mixture | None
    """None where nothing is held out."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""

    def lines(self) -> list[str]:
        """One line per source: how much of it is for training."""
        lines = []
        for source, indices in zip(self.mixture.sources, self.mixture.indices, strict=True):
            count = len(indices)
            lines.append(f"data: {count} pairs to train on, {len(source) - count} held out, {source.name}")
        return lines


def open_training_data(options: DataOptions, seed: int, recipe: Recipe | None) -> TrainingData:
    """Open the sources and hold out scenes.

    Args:
        options: the folders.
        seed: of the drawing.
        recipe: its sources must all be given, and its weights hold where the options have none.

    Raises:
        ValueError: a folder is broken, no or not the recipe's sources are given, or the weights do not fit.
    """
    width, height = parse_image_size(options.size, multiple_of=16)
    kinds: Sequence[tuple[str, Sequence[str]]] = (
        ("pairs", options.pairs),
        ("generated", options.generated),
        ("orida", options.orida),
    )
    weights = options.weights
    if recipe:
        shares = recipe.weights({name: len(folders) for name, folders in kinds})
        weights = weights or shares
    sources: list[PairSource] = []
    for name, folders in kinds:
        sources += [_open(folder, rendered=name == "pairs") for folder in folders]
    if not sources:
        raise ValueError("training data: expected --pairs, --generated or --orida, found none")
    mixture, held_out = split_mixture(sources, weights=weights, held_out=options.held_out, seed=seed)
    return TrainingData(mixture, held_out, width, height)


def _open(address: str, *, rendered: bool) -> PairSource:
    """Packed pairs where there is an index or an address such as s3://, otherwise a folder of pictures."""
    folder = Path(address)
    if "://" in address or (folder / INDEX_FILE).is_file():
        return PackedPairs(address)
    return RenderedPairs(folder) if rendered else RelitPairs(folder)
