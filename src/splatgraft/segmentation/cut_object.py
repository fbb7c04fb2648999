"""Object masks of posed pictures that agree in 3D: cut, lifted to the Gaussians, rendered, and cut again."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.prompts import ViewPrompt
from splatgraft.rendering import RenderOptions, view_operator
from splatgraft.runtime.progress import Progress, silent
from splatgraft.segmentation.lift import blended_share
from splatgraft.segmentation.mask_agreement import overlap
from splatgraft.segmentation.view_cutter import Evidence, ViewCutter

LEAST_PIXELS = 12
"""Pixels of the selection below which a picture does not show the object."""


@dataclass(frozen=True)
class CutOptions:
    """When the masks agree; values set by hand."""

    rounds: int = 2
    """Most rounds before the last, which cuts every picture."""
    voting: int = 32
    """Most pictures, evenly spaced, that are cut in the rounds before the last."""
    settled: float = 0.97
    """Mean IoU of the masks with those of the round before from which another round would change nothing that shows."""


@dataclass(frozen=True)
class CutViews:
    """v pictures that are cut, and what the user says about some."""

    images: Sequence[Float[Tensor, "_ _ 3"]]
    """sRGB in [0, 1], one per camera."""
    cameras: Cameras
    """Of the pictures, on the device of the scene."""
    prompts: Mapping[int, ViewPrompt] = field(default_factory=dict)
    """Points and rectangles by index of the picture, in its pixels."""


@dataclass(frozen=True)
class FirstGuess:
    """What is known of the object in 3D before a picture is cut."""

    share: Float[Tensor, "n"] | Bool[Tensor, "n"]
    """Of each Gaussian that is the object's, in [0, 1]."""
    allowed: Bool[Tensor, "n"] | None = None
    """Which Gaussians may be the object's whatever the pictures say; None for all."""


@dataclass(frozen=True)
class CutMasks:
    """The masks, and how the rounds went."""

    masks: tuple[Float[Tensor, "_ _"], ...]
    """0 or 1, one per picture."""
    feature: Float[Tensor, "n"]
    """Share of each Gaussian in the masks, in [0, 1]."""
    change: tuple[float, ...] = field(default=())
    """Mean IoU of the masks of each round with those of the round before."""


def cut_object(
    views: CutViews,
    scene: Gaussians,
    guess: FirstGuess,
    cutter: ViewCutter,
    *,
    options: CutOptions = CutOptions(),
    progress: Progress = silent,
) -> CutMasks:
    """Cut the object out of every picture, in rounds, until the masks no longer change.

    Each round renders the 3D selection into every picture, cuts the picture, and lifts all masks together to a new
    selection: a mask that is wrong in one picture is outvoted by the others, and what is not allowed stays outside, so
    that masks do not grow from round to round over a wall of the object's colour.

    Args:
        views: The pictures.
        scene: n Gaussians.
        guess: First selection, and what may be added to it.
        cutter: The algorithm for one picture.
        options: When to stop.
        progress: Called per picture.

    Raises:
        ValueError: Where fewer than two pictures show the selection.
    """
    count = len(views.images)
    voting = sorted({round(i) for i in torch.linspace(0, count - 1, min(count, options.voting)).tolist()})
    feature, changes = guess.share.float().to(scene.device), []
    allowed = torch.ones_like(feature) if guess.allowed is None else guess.allowed.float().to(scene.device)
    masks: dict[int, Tensor] = {}

    def cut_and_lift(chosen: Sequence[int], what: str) -> tuple[dict[int, Tensor], Tensor]:
        made, lifted = _round(views, scene, feature, chosen, cutter, _told(progress, what))
        return made, lifted * allowed

    for round_ in range(options.rounds):
        before = masks
        masks, feature = cut_and_lift(voting, f"round {round_ + 1}")
        if before:
            same = torch.tensor([overlap(masks[i], before[i]) for i in voting])
            changes.append(float(same.nanmean()))
            if changes[-1] > options.settled:
                break
    if len(voting) < count:
        masks, feature = cut_and_lift(range(count), "every picture")
    progress(count, count, "masks cut")
    if sum(bool(mask.any()) for mask in masks.values()) < 2:
        raise ValueError(
            "object: expected at least two pictures that show what was found at its place, found fewer; give its "
            "--box, or --prompts with clicks in two or three pictures"
        )
    return CutMasks(tuple(masks[i] for i in range(count)), feature, tuple(changes))


def _told(progress: Progress, what: str) -> Progress:
    return lambda done, total, _: progress(done, total, f"cutting masks, {what}")


def _round(
    views: CutViews,
    scene: Gaussians,
    feature: Float[Tensor, "n"],
    chosen: Sequence[int],
    cutter: ViewCutter,
    progress: Progress,
) -> tuple[dict[int, Tensor], Float[Tensor, "n"]]:
    """The masks of the chosen pictures, cut by the evidence of `feature`, and the feature lifted from them."""
    total, masks = torch.zeros(scene.count, 2, device=scene.device), {}
    for done, index in enumerate(chosen):
        progress(done, len(chosen), "")
        operator = view_operator(scene, views.cameras[index], RenderOptions())
        evidence = Evidence(operator.blend(feature[:, None])[..., 0].cpu(), views.prompts.get(index, ViewPrompt()))
        # a picture in which neither the selection nor a click shows has no object
        shows = int((evidence.lifted > 0.5).sum()) >= LEAST_PIXELS or len(evidence.prompt.inside)
        masks[index] = cutter.cut(views.images[index], evidence) if shows else torch.zeros_like(evidence.lifted)
        inside = masks[index].to(scene.device)
        total += operator.blend_transpose(torch.stack([inside, torch.ones_like(inside)], -1))
    return masks, blended_share(total)
