"""The object's mask in one picture by GrabCut (Rother et al. 2004; OpenCV), which separates by colour.

What the object is comes from the 3D selection, rendered into the picture; colour decides only in a band along its
outline, since over a whole picture it takes a table of the object's colour or leaves out a part of another one.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatgraft.core.prompts import ViewPrompt
from splatgraft.segmentation.view_cutter import Evidence


@dataclass(frozen=True)
class GrabCut:
    """How object and surroundings are separated; values set by hand."""

    iterations: int = 2
    """GrabCut iterations per picture."""
    lightness: float = 0.5
    """Weight of lightness against colour: below 1, a shadow looks more like the ground on which it lies."""
    certain: float = 0.95
    """Lifted share from which a pixel is certainly object; below 1 - `certain` it is certainly surroundings."""
    band: float = 0.06
    """Half width of the band along the outline in which colour decides, over the square root of the mask's area."""
    window: float = 0.5
    """Margin around the object that is looked at, over the larger side of its bounding box."""
    click_px: int = 3
    """Radius of the disc around a point that the user gave, pixels."""
    speck: int = 50
    """The largest part of the mask over the largest part that is removed, by area."""
    hole: int = 1000
    """The mask over the largest hole that is filled, by area."""

    def cut(self, image: Float[Tensor, "h w 3"], evidence: Evidence) -> Float[Tensor, "h w"]:
        """The object's mask, 0 or 1."""
        prior = self._prior(evidence.lifted.cpu().numpy(), evidence.prompt)
        labels = np.zeros_like(prior)
        rows, columns = _window((prior != cv2.GC_BGD), self.window)
        labels[rows, columns] = self._labels(image[rows, columns], prior[rows, columns])
        return torch.from_numpy(self._without_specks(labels))

    def _prior(self, lifted: Float[np.ndarray, "h w"], prompt: ViewPrompt) -> UInt8[np.ndarray, "h w"]:
        """GrabCut's classes: certain and likely object and surroundings."""
        likely = (lifted > 0.5).astype(np.uint8)
        width = max(1, round(self.band * float(likely.sum()) ** 0.5))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * width + 1, 2 * width + 1))
        near, core = cv2.dilate(likely, disc) > 0, cv2.erode(likely, disc, borderValue=1) > 0
        prior = np.where(likely > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
        prior[core | (near & (lifted > self.certain))] = cv2.GC_FGD
        prior[~near | (~core & (lifted < 1 - self.certain))] = cv2.GC_BGD
        if prompt.box is not None:
            prior[~_inside(prompt.box, prior.shape)] = cv2.GC_BGD
        for points, value in ((prompt.outside, cv2.GC_BGD), (prompt.inside, cv2.GC_FGD)):
            for x, y in points.tolist():
                cv2.circle(prior, (int(x), int(y)), self.click_px, value, -1)
        return prior

    def _labels(self, image: Float[Tensor, "h w 3"], prior: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
        rgb = (image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
        lab[..., 0] = np.round(self.lightness * lab[..., 0].astype(np.float32)).astype(np.uint8)
        labels = prior.copy()
        if (prior % 2 == 1).any() and (prior % 2 == 0).any():
            cv2.setRNGSeed(0)
            unused = (0, 0, 0, 0)  # the rectangle, which GC_INIT_WITH_MASK ignores
            models = np.zeros((1, 65)), np.zeros((1, 65))
            cv2.grabCut(lab, labels, unused, *models, self.iterations, cv2.GC_INIT_WITH_MASK)
        return (labels % 2).astype(np.uint8)

    def _without_specks(self, mask: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """The mask without small separate parts and small holes."""
        for value in (1, 0):
            count, labels, stats, _ = cv2.connectedComponentsWithStats((mask == value).astype(np.uint8), connectivity=4)
            if count > 1:
                areas = stats[1:, cv2.CC_STAT_AREA]
                limit = areas.max() / self.speck if value == 1 else int((mask == 1).sum()) / self.hole
                small = np.flatnonzero(areas < limit) + 1
                mask = np.where(np.isin(labels, small), 1 - value, mask).astype(np.uint8)
        return mask.astype(np.float32)


def _inside(box: tuple[float, float, float, float], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Which pixel centres lie in the rectangle."""
    rows, columns = np.ogrid[0.5 : shape[0], 0.5 : shape[1]]
    return (columns >= box[0]) & (columns <= box[2]) & (rows >= box[1]) & (rows <= box[3])


def _window(shown: Bool[np.ndarray, "h w"], margin: float) -> tuple[slice, slice]:
    """Rows and columns of the bounding box of `shown` with a margin; everything where nothing shows."""
    if not shown.any():
        return slice(None), slice(None)
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    extra = int(margin * max(len(rows), len(columns))) + 2
    return (
        slice(max(0, int(rows[0]) - extra), int(rows[-1]) + extra + 1),
        slice(max(0, int(columns[0]) - extra), int(columns[-1]) + extra + 1),
    )
