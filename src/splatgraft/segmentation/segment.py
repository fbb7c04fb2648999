"""Segmentation of a scene into an object and its surroundings, by the object masks of the scene's capture."""

from dataclasses import dataclass, replace

from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.posed_images import PosedImages
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft.runtime.progress import Progress, silent
from splatgraft.segmentation.lift import LiftOptions, lift_masks
from splatgraft.segmentation.selection import SelectOptions, select_object
from splatgraft.segmentation.solidify import SolidifyOptions, solidify_object
from splatgraft.segmentation.unseen_side import close_unseen_side


@dataclass(frozen=True)
class Segmentation:
    """A scene of n Gaussians divided into an object and its surroundings."""

    object: Gaussians
    """The object's Gaussians, made solid if asked for, and closed on the unseen side."""
    surroundings: Gaussians
    """All other Gaussians of the scene, unchanged."""
    selection: Bool[Tensor, "n"]
    """Whether a Gaussian of the scene belongs to the object."""
    feature: Float[Tensor, "n"]
    """Share of each Gaussian's blending weight inside the masks, in [0, 1]."""
    is_guessed: Bool[Tensor, "k"]
    """Whether a Gaussian of the object closes its unseen side."""


def segment(
    scene: Gaussians,
    capture: PosedImages,
    *,
    lift: LiftOptions = LiftOptions(),
    select: SelectOptions = SelectOptions(),
    solidify: SolidifyOptions | None = SolidifyOptions(),
    progress: Progress = silent,
) -> Segmentation:
    """Divide a scene into the object that the masks of its capture show and everything else.

    1. Lift the masks to the Gaussians (`lift_masks`).
    2. Select Gaussians by threshold, box and connected component (`select_object`).
    3. Fit the object alone to its masked images, so that it is opaque without its surroundings (`solidify_object`).
    4. Close the side that no image shows (`close_unseen_side`).

    Args:
        scene: n Gaussians reconstructed from `capture`.
        capture: The capture with object masks; views without a mask are not used.
        lift: Method of lifting the masks.
        select: Criteria for the object's Gaussians.
        solidify: Length and detail of the fit of the object alone; None keeps its Gaussians unchanged.
        progress: Called with steps done, steps in all and a short text.

    Raises:
        ValueError: The capture has no masks, or no Gaussian meets the criteria.
    """
    masked = capture.with_masks()
    if len(masked) == 0:
        raise ValueError(f"segment: expected masks of the object for some of {len(capture)} views, found none")
    cameras = masked.cameras.to(scene.device)
    masks = LazySequence(len(masked), lambda index: _mask(masked, index))
    feature = lift_masks(scene, cameras, masks, lift, progress=progress)
    selection = select_object(scene, feature, select)
    chosen = scene.select(selection)
    if solidify is not None and solidify.iterations:
        photographs = LazySequence(len(masked), lambda index: (masked.image(index), masks[index]))
        options = replace(solidify, threshold=select.threshold)
        chosen = solidify_object(scene, selection, cameras, photographs, options=options, progress=progress)
    closed = close_unseen_side(chosen, cameras, masks)
    return Segmentation(
        closed.gaussians.to(scene.device), scene.select(~selection), selection, feature, closed.is_guessed
    )


def _mask(capture: PosedImages, index: int) -> Float[Tensor, "h w"]:
    mask = capture.mask(index)
    assert mask is not None
    return mask
