"""Object mask of one picture by GrabCut (Rother et al. 2004; OpenCV), which separates by colour.

The 3D selection, rendered into the picture, defines the object. Colour decides only in a band along its outline.
Over a whole picture, colour would add a table of the object's colour, or leave out a part of another colour. All
constants are set by hand.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatgraft.core.prompts import ViewPrompt

_ITERATIONS = 2  # GrabCut iterations per picture
_LIGHTNESS = 0.5  # weight of lightness against colour; below 1, a shadow is more similar to the ground around it
_CERTAIN = 0.95  # lifted share above which a pixel is certainly object; below one minus this, certainly background
_BAND = 0.06  # half width of the band along the outline in which colour decides, over sqrt(mask area)
_WINDOW = 0.5  # margin of GrabCut's window around the object, over the larger side of its bounding box
_CLICK_PX = 3  # radius of the disc around a user's point
_SPECK = 50  # area of the largest part of the mask over that of the largest removed part
_HOLE = 1000  # area of the mask over that of the largest filled hole


def grabcut_mask(
    image: Float[Tensor, "h w 3"], lifted: Float[Tensor, "h w"], prompt: ViewPrompt
) -> Float[Tensor, "h w"]:
    """Cut the object out of one picture by GrabCut; a `ViewCutter`.

    Args:
        image: sRGB in [0, 1].
        lifted: Share of each pixel that belongs to the object by the 3D selection.
        prompt: The user's points and rectangle.

    Returns:
        The object's mask, 0 or 1.
    """
    prior = _prior(lifted.cpu().numpy(), prompt)
    labels = np.zeros_like(prior)
    window = _window(prior != cv2.GC_BGD)
    labels[window] = _labels(image[window], prior[window])
    return torch.from_numpy(_without_specks(labels))


def _prior(lifted: Float[np.ndarray, "h w"], prompt: ViewPrompt) -> UInt8[np.ndarray, "h w"]:
    """Compute GrabCut's classes: certain and likely object, certain and likely background."""
    likely = (lifted > 0.5).astype(np.uint8)
    width = max(1, round(_BAND * float(likely.sum()) ** 0.5))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * width + 1, 2 * width + 1))
    near, core = cv2.dilate(likely, disc) > 0, cv2.erode(likely, disc, borderValue=1) > 0
    prior = np.where(likely > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    prior[core | (near & (lifted > _CERTAIN))] = cv2.GC_FGD
    prior[~near | (~core & (lifted < 1 - _CERTAIN))] = cv2.GC_BGD
    if prompt.box is not None:
        left, top, right, bottom = prompt.box
        rows, columns = np.ogrid[0.5 : prior.shape[0], 0.5 : prior.shape[1]]
        prior[~((columns >= left) & (columns <= right) & (rows >= top) & (rows <= bottom))] = cv2.GC_BGD
    for points, value in ((prompt.outside, cv2.GC_BGD), (prompt.inside, cv2.GC_FGD)):
        for x, y in points.tolist():
            cv2.circle(prior, (int(x), int(y)), _CLICK_PX, value, -1)
    return prior


def _window(shown: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Return rows and columns of the bounding box of `shown` with a margin; the whole picture if it is empty."""
    if not shown.any():
        return slice(None), slice(None)
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    extra = int(_WINDOW * max(len(rows), len(columns))) + 2
    return (
        slice(max(0, int(rows[0]) - extra), int(rows[-1]) + extra + 1),
        slice(max(0, int(columns[0]) - extra), int(columns[-1]) + extra + 1),
    )


def _labels(image: Float[Tensor, "h w 3"], prior: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    rgb = (image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    lab[..., 0] = np.round(_LIGHTNESS * lab[..., 0].astype(np.float32)).astype(np.uint8)
    labels = prior.copy()
    if (prior % 2 == 1).any() and (prior % 2 == 0).any():
        cv2.setRNGSeed(0)
        unused = (0, 0, 0, 0)  # the rectangle, which GC_INIT_WITH_MASK ignores
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(lab, labels, unused, *models, _ITERATIONS, cv2.GC_INIT_WITH_MASK)
    return (labels % 2).astype(np.uint8)


def _without_specks(mask: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Remove small separate parts of the mask and fill small holes."""
    for value in (1, 0):
        count, labels, stats, _ = cv2.connectedComponentsWithStats((mask == value).astype(np.uint8), connectivity=4)
        if count > 1:
            areas = stats[1:, cv2.CC_STAT_AREA]
            limit = areas.max() / _SPECK if value == 1 else int((mask == 1).sum()) / _HOLE
            small = np.flatnonzero(areas < limit) + 1
            mask = np.where(np.isin(labels, small), 1 - value, mask).astype(np.uint8)
    return mask.astype(np.float32)
