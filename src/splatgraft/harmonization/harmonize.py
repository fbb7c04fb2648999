"""Harmonisation of all views of a composite with one method."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.interface import BatchHarmonizer, Harmonized, Harmonizer, HarmonizerInputs
from splatgraft.harmonization.methods import make_harmonizer
from splatgraft.runtime.progress import Progress, silent


@dataclass(frozen=True)
class HarmonizedViews:
    """The harmonised images of v views, as `consolidate` takes them."""

    images: tuple[Float[Tensor, "_ _ 3"], ...]
    """One (h, w, 3) sRGB image in [0, 1] per view."""
    confidence: tuple[Float[Tensor, "_ _"], ...] | None
    """One (h, w) confidence in [0, 1] per view, the `weights` of `consolidate`; None where the method gives none."""

    def __len__(self) -> int:
        return len(self.images)


def harmonize(
    views: Sequence[HarmonizerInputs], method: str | Harmonizer = "compact", *, progress: Progress = silent
) -> HarmonizedViews:
    """Make the light of every view agree, each view by itself.

    Args:
        views: v views, as `render_views` gives them; each is read once.
        method: Name of a method with its default options (`none` keeps the light prior, `compact` is the shipped
            network, `reinhard` a baseline, `flux` the paper's model), or a harmoniser made by `make_harmonizer`.
        progress: Called after every view with views done, v, and the number of the view.

    Returns:
        The images and, where the method estimates it, their confidence.

    Raises:
        ValueError: There is no method of that name, or its weights or packages are missing.
    """
    harmonizer = make_harmonizer(method) if isinstance(method, str) else method
    made: list[Harmonized] = []
    for batch in _batches(views, harmonizer.views_at_once if isinstance(harmonizer, BatchHarmonizer) else 1):
        if isinstance(harmonizer, BatchHarmonizer):
            made += harmonizer.harmonize_all(batch)
        else:
            made += [harmonizer.harmonize(view) for view in batch]
        progress(len(made), len(views), f"view {len(made)}")
    confidence = tuple(one.confidence for one in made if one.confidence is not None)
    return HarmonizedViews(tuple(one.image for one in made), confidence if len(confidence) == len(made) else None)


def _batches(views: Sequence[HarmonizerInputs], at_once: int) -> Iterator[list[HarmonizerInputs]]:
    """Consecutive views of one size, at most `at_once` together."""
    batch: list[HarmonizerInputs] = []
    for view in views:
        if batch and (len(batch) == at_once or view.composite.shape != batch[0].composite.shape):
            yield batch
            batch = []
        batch.append(view)
    if batch:
        yield batch
