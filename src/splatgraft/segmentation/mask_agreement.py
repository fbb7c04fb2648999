"""How well the masks of single pictures agree with the object that they have in common: the selection, rendered."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import RenderOptions, view_operator
from splatgraft.runtime.progress import Progress, silent

LEAST_AGREEMENT = 0.7
"""Mean IoU below which the object is doubtful: almost a third of what masks and selection cover differs. An outline
that misses by 2% of the object's diameter all around gives 0.92; thin parts in a short reconstruction give 0.8."""
DOUBTFUL_VIEW = 0.5
"""IoU below which the mask of one picture is doubtful: it has less in common with the object than not."""


@dataclass(frozen=True)
class Agreement:
    """Intersection over union of each picture's mask and the rendered selection."""

    names: tuple[str, ...]
    """Of the pictures."""
    iou: Float[Tensor, "v"]
    """In [0, 1]; nan where neither mask nor selection shows in the picture."""

    @property
    def mean(self) -> float:
        """Mean over the pictures that show the object; 0 where none does."""
        return float(self.iou.nanmean().nan_to_num(0.0))

    @property
    def doubtful(self) -> list[int]:
        """Pictures whose mask is doubtful, the worst first."""
        return [int(i) for i in self.iou.nan_to_num(1.0).argsort() if float(self.iou[i]) < DOUBTFUL_VIEW]

    def as_json(self) -> dict[str, object]:
        """The mean, and the value of each picture that shows the object."""
        views = {n: round(float(v), 4) for n, v in zip(self.names, self.iou, strict=True) if not bool(v.isnan())}
        return {"mean_iou": round(self.mean, 4), "views": views}


def measure_agreement(
    masks: Sequence[Float[Tensor, "_ _"]],
    scene: Gaussians,
    cameras: Cameras,
    selection: Bool[Tensor, "n"],
    *,
    progress: Progress = silent,
) -> Agreement:
    """Compare the masks with the selected Gaussians, rendered in front of and behind all others.

    Args:
        masks: One per camera, of its size, in [0, 1].
        scene: n Gaussians.
        cameras: Of the masks.
        selection: The object's Gaussians.
        progress: Called per picture.
    """
    feature = selection[:, None].float().to(scene.device)
    values = []
    for index, (mask, camera) in enumerate(zip(masks, cameras, strict=True)):
        progress(index, len(masks), "comparing masks with the selection")
        shown = view_operator(scene, camera, RenderOptions()).blend(feature)[..., 0]
        values.append(overlap(mask.to(shown), shown))
    progress(len(masks), len(masks), "comparing masks with the selection")
    return Agreement(cameras.names, torch.tensor(values))


def overlap(first: Float[Tensor, "h w"], second: Float[Tensor, "h w"]) -> float:
    """Intersection over union of two masks at one half; nan where both are empty."""
    a, b = first > 0.5, second > 0.5
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else float("nan")
