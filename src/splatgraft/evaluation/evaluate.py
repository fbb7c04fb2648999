"""Metrics of the pictures of one result against ground truth, as means over views."""

import math
from collections.abc import Sequence
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from splatgraft.core.posed_images import PosedImages
from splatgraft.evaluation.measure import Perceptual, compare
from splatgraft.evaluation.regions import Truth, find_regions
from splatgraft.runtime.lazy_sequence import LazySequence


def evaluate(
    images: Sequence[Float[Tensor, "_ _ 3"]],
    truth: Sequence[Truth],
    *,
    backgrounds: Sequence[Float[Tensor, "_ _ 3"]],
    perceptual: Perceptual | None = None,
) -> dict[str, float | None]:
    """Measure the pictures of a result against the ground truth of the same views.

    Args:
        images: v pictures (h, w, 3) of the result, sRGB in [0, 1].
        truth: The ground truth of each view, as `true_views` gives it.
        backgrounds: A render of the target scene without the object for each view, sRGB in [0, 1]: the error of the
            reconstruction itself then cancels in `shadow_ratio_rmse` and `rest_*_change`.
        perceptual: A distance between two (h, w, 3) images such as LPIPS; without it there is no "lpips".

    Returns:
        `psnr` (dB), `ssim` and `flip` of the whole image and of the regions object, shadow and rest;
        `shadow_ratio_rmse`, the error of the shadow as a ratio of linear luminance; `rest_max_change` and
        `rest_mean_change` (sRGB). Each is the mean over the views in which its region has at least 25 pixels (the
        maximum for `rest_max_change`), and None where no view has.

    Raises:
        ValueError: There is not one truth and one background per picture.
    """
    if not len(images) == len(truth) == len(backgrounds):
        found = f"{len(images)} images, {len(truth)} truths and {len(backgrounds)} backgrounds"
        raise ValueError(f"evaluate: expected one truth and one background per image, found {found}")
    rows = [
        compare(
            image.clamp(0, 1),
            true,
            regions=find_regions(true),
            background=background.clamp(0, 1),
            perceptual=perceptual,
        )
        for image, true, background in zip(images, truth, backgrounds, strict=True)
    ]
    means: dict[str, float | None] = {}
    for name in rows[0] if rows else ():
        values = [row[name] for row in rows if math.isfinite(row[name])]
        joined = max if name == "rest_max_change" else (lambda v: sum(v) / len(v))
        means[name] = joined(values) if values else None
    return means


def true_views(truth: PosedImages, target: PosedImages) -> LazySequence[Truth]:
    """The ground truth of every view: the images with the object, the target's images of the same name, the masks.

    Args:
        truth: A capture of the target with the object really in it, with a mask of the object for every view.
        target: The capture of the target without the object.

    Returns:
        One `Truth` per view of `truth`, read when asked for.

    Raises:
        ValueError: A view of the truth has no mask, or no image of the same name in the target.
    """
    for index, path in enumerate(truth.mask_paths or (None,) * len(truth)):
        if path is None:
            raise ValueError(f"{truth.image_paths[index]}: expected a mask of the object, found none")
    index_of = {Path(name).stem: index for index, name in enumerate(target.cameras.names)}
    stems = [Path(name).stem for name in truth.cameras.names]
    if missing := [stem for stem in stems if stem not in index_of]:
        raise ValueError(f"evaluate: expected an image of the target named {missing[0]} as in the truth, found none")

    def read(index: int) -> Truth:
        mask = truth.mask(index)
        assert mask is not None
        return Truth(image=truth.image(index), background=target.image(index_of[stems[index]]), mask=mask)

    return LazySequence(len(truth), read)
