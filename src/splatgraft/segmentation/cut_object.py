"""Object masks of posed pictures that are consistent in 3D.

Each round cuts the object out of every picture, lifts all masks to the Gaussians, and renders this selection into the
pictures for the next round. The agreement of the final masks is their IoU with the rendered selection.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.prompts import ViewPrompt
from splatgraft.rendering import RenderOptions, view_operator
from splatgraft.runtime.progress import Progress, silent
from splatgraft.segmentation.lift import share_inside, weight_inside
from splatgraft.segmentation.object_region import ObjectRegion

MIN_AGREEMENT = 0.7
"""Mean IoU below which the object is doubtful. An outline that is off by 2% of the object's diameter all around gives
0.92; thin parts in a short reconstruction give 0.8."""
_MIN_VIEW_AGREEMENT = 0.5  # IoU below which the mask of one picture is doubtful
_MIN_PIXELS = 12  # fewest pixels of the selection in a picture that shows the object
_ROUNDS = 2  # most rounds before the last, which cuts every picture; set by hand
_VOTING = 32  # most pictures, evenly spaced, that are cut in the rounds before the last; set by hand
_SETTLED = 0.97  # mean IoU with the masks of the round before, above which another round has no visible effect


ViewCutter = Callable[[Tensor, Tensor, ViewPrompt], Tensor]
"""Algorithm that cuts the object out of one picture: `grabcut_mask`, or the method `cut` of a loaded `Sam2`.

Arguments: the picture (h, w, 3), sRGB in [0, 1]; the share (h, w) of each pixel that belongs to the object by the 3D
selection, not 0 everywhere; the user's points and rectangle. Result: the object's mask (h, w), 0 or 1."""


@dataclass(frozen=True)
class CutViews:
    """v pictures to cut, and the user's points and rectangles in some of them."""

    images: Sequence[Float[Tensor, "_ _ 3"]]
    """sRGB in [0, 1], one per camera."""
    cameras: Cameras
    """Cameras of the pictures, on the device of the scene."""
    prompts: Mapping[int, ViewPrompt] = field(default_factory=dict)
    """Points and rectangles by index of the picture, in its pixels."""


@dataclass(frozen=True)
class Agreement:
    """Intersection over union of each picture's mask and the rendered selection."""

    names: tuple[str, ...]
    """Names of the pictures."""
    iou: Float[Tensor, "v"]
    """IoU in [0, 1]; nan if neither mask nor selection shows in the picture."""

    @property
    def mean(self) -> float:
        """Mean IoU over the pictures that show the object; 0 without such pictures."""
        return float(self.iou.nanmean().nan_to_num(0.0))

    @property
    def doubtful(self) -> list[int]:
        """Indices of the pictures with a doubtful mask, the worst first."""
        return [int(i) for i in self.iou.nan_to_num(1.0).argsort() if float(self.iou[i]) < _MIN_VIEW_AGREEMENT]

    def as_json(self) -> dict[str, object]:
        """Return the mean, and the IoU of each picture that shows the object."""
        views = {n: round(float(v), 4) for n, v in zip(self.names, self.iou, strict=True) if not bool(v.isnan())}
        return {"mean_iou": round(self.mean, 4), "views": views}


def cut_object(
    views: CutViews,
    scene: Gaussians,
    *,
    share: Float[Tensor, "n"] | Bool[Tensor, "n"],
    cutter: ViewCutter,
    region: ObjectRegion | None = None,
    progress: Progress = silent,
) -> tuple[list[Float[Tensor, "_ _"]], Float[Tensor, "n"]]:
    """Cut the object out of every picture, in rounds, until the masks no longer change.

    Each round renders the 3D selection into every picture, cuts the picture, and lifts all masks together to a new
    selection. The other pictures outvote a wrong mask. The region keeps masks from growing over a wall of the object's
    colour, and adds a foot of another colour between the selection and the support.

    Args:
        views: The pictures.
        scene: n Gaussians.
        share: First selection: share of each Gaussian in the object, in [0, 1].
        cutter: Algorithm for one picture.
        region: Region that bounds the object and has its support; None allows all Gaussians.
        progress: Called per picture.

    Returns:
        A mask per picture, 0 or 1, and the share of each Gaussian inside the masks, in [0, 1].

    Raises:
        ValueError: Fewer than two pictures show the object.
    """
    count = len(views.images)
    voting = sorted({round(i) for i in torch.linspace(0, count - 1, min(count, _VOTING)).tolist()})
    feature = share.float().to(scene.device)
    may_be = torch.ones_like(feature) if region is None else region.allows(scene.means).float()
    masks: dict[int, Tensor] = {}

    def cut_and_lift(chosen: Sequence[int], what: str) -> tuple[dict[int, Tensor], Tensor]:
        """Cut the chosen pictures by `feature` and the object's foot, and lift their masks to a new feature."""
        total, made = torch.zeros(scene.count, 2, device=scene.device), {}
        foot = torch.zeros_like(feature) if region is None else region.foot(scene, feature).float()
        wanted = torch.stack([torch.maximum(feature, foot), foot], 1)
        for done, index in enumerate(chosen):
            progress(done, len(chosen), f"cutting masks, {what}")
            operator = view_operator(scene, views.cameras[index], RenderOptions())
            lifted, is_foot = operator.blend(wanted).cpu().unbind(-1)
            prompt = views.prompts.get(index, ViewPrompt())
            # without a visible selection or click, the mask is empty
            shows = int((lifted > 0.5).sum()) >= _MIN_PIXELS or len(prompt.inside)
            cut = cutter(views.images[index], lifted, prompt) if shows else torch.zeros_like(lifted)
            # in a picture with the user's points or rectangle, these decide
            made[index] = cut if index in views.prompts else torch.where(is_foot > 0.5, 1.0, cut)
            total += weight_inside(operator, made[index].to(scene.device))
        return made, share_inside(total) * may_be

    for round_ in range(_ROUNDS):
        before = masks
        masks, feature = cut_and_lift(voting, f"round {round_ + 1}")
        if before and float(torch.tensor([_iou(masks[i], before[i]) for i in voting]).nanmean()) > _SETTLED:
            break
    if len(voting) < count:
        masks, feature = cut_and_lift(range(count), "every picture")
    progress(count, count, "masks cut")
    if sum(bool(mask.any()) for mask in masks.values()) < 2:
        raise ValueError(
            "object: expected at least two pictures that show what was found at its place, found fewer; give its "
            "--box, or --prompts with clicks in two or three pictures"
        )
    return [masks[i] for i in range(count)], feature


def measure_agreement(
    masks: Sequence[Float[Tensor, "_ _"]],
    scene: Gaussians,
    cameras: Cameras,
    selection: Bool[Tensor, "n"],
    *,
    progress: Progress = silent,
) -> Agreement:
    """Compare the masks, one per camera, with the selected Gaussians rendered among all others."""
    feature = selection[:, None].float().to(scene.device)
    values = []
    for index, (mask, camera) in enumerate(zip(masks, cameras, strict=True)):
        progress(index, len(masks), "comparing masks with the selection")
        shown = view_operator(scene, camera, RenderOptions()).blend(feature)[..., 0]
        values.append(_iou(mask.to(shown), shown))
    progress(len(masks), len(masks), "comparing masks with the selection")
    return Agreement(cameras.names, torch.tensor(values))


def _iou(first: Float[Tensor, "h w"], second: Float[Tensor, "h w"]) -> float:
    """Compute the intersection over union of two masks, thresholded at 0.5; nan if both are empty."""
    a, b = first > 0.5, second > 0.5
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else float("nan")
