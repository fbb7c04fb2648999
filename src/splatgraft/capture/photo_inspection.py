"""What photos tell before poses are sought: sharpness, overlap, brightness and copies, from small grey versions.

Overlap is counted in SIFT matches between photos that follow one another (Lowe 2004: ratio test), verified by epipolar
geometry (USAC, MAGSAC++). The same matches tell the exposure of each photo against the others, as one surface should
have one brightness. Sharpness is the perceptual blur metric of Crete-Roffet et al. 2007, which depends little on what
is shown: how much the picture loses when it is blurred once more.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from splatgraft.runtime.progress import Progress, silent

SIDE_PX = 640
"""Longest side of the grey versions: that of a draft reconstruction."""

Grey = UInt8[np.ndarray, "h w"]
"""sRGB luma."""


@dataclass(frozen=True)
class InspectionOptions:
    """How photos are matched."""

    features: int = 1200
    """SIFT features per photo, the strongest."""
    neighbours: int = 3
    """Photos that follow in the order of names (in a ring) with which each is matched."""
    ratio: float = 0.8
    """Distance of the best match over that of the second, at most (Lowe 2004)."""
    epipolar_px: float = 1.5
    """Distance of a match from its epipolar line, at most."""
    link: int = 15
    """Verified matches from which two photos show the same place: what COLMAP demands (min_num_inliers)."""
    candidates: int = 20
    """Photos elsewhere in the order with which a photo without a neighbour is matched, at most."""
    still_px: float = 0.5
    """Median shift of the matches below which two photos are one: below what a hand can hold still."""


@dataclass(frozen=True)
class Link:
    """Two photos that show the same place."""

    first: int
    """Index of a photo."""
    second: int
    """Index of another photo."""
    matches: int
    """Verified matches."""
    shift_px: float
    """Median shift of the matches, pixels of the grey versions."""
    stops: float
    """How much brighter the second photo shows the same surfaces, median over matches."""


@dataclass(frozen=True)
class Inspection:
    """What was found in n photos."""

    blur: tuple[float, ...]
    """Of each photo, in [0, 1]; 0 is sharp."""
    links: tuple[Link, ...]
    """Pairs of photos that show the same place, as far as they were looked for."""
    groups: tuple[tuple[int, ...], ...]
    """Photos that hang together by links, the largest group first."""
    jumps: tuple[float, ...]
    """How much brighter each photo shows surfaces than the photos before and after it do, stops."""
    same: tuple[tuple[int, int], ...]
    """Pairs of photos from one place without any movement."""


@dataclass(frozen=True)
class _Features:
    points: np.ndarray
    descriptors: np.ndarray
    luminance: np.ndarray


def inspect_photos(
    photos: Iterable[Grey], options: InspectionOptions = InspectionOptions(), *, progress: Progress = silent, count: int
) -> Inspection:
    """Inspect photos in the order in which they were taken.

    Args:
        photos: Grey versions, longest side at most `SIDE_PX`; read one at a time.
        options: How photos are matched.
        progress: Called per photo.
        count: Number of photos.
    """
    blur: list[float] = []
    features: list[_Features] = []
    sift = cv2.SIFT.create(nfeatures=options.features)
    for index, photo in enumerate(photos):
        blur.append(blur_of(photo))
        features.append(_features(sift, photo))
        progress(index + 1, count, "looking at photos")
    n = len(features)
    links: dict[tuple[int, int], Link] = {}

    def match(pairs: Iterable[tuple[int, int]]) -> None:
        for i, j in pairs:
            if i != j and (i, j) not in links and (found := _link(features, i, j, options)) is not None:
                links[i, j] = found

    steps = range(1, min(options.neighbours, n - 1) + 1)
    for index in range(n):
        match(_pair(index, (index + step) % n) for step in steps)
        progress(index + 1, n, "comparing neighbours")
    match(_across(groups_of(n, links), options))
    found = tuple(links.values())
    groups = groups_of(n, links)
    same = tuple((link.first, link.second) for link in found if link.shift_px < options.still_px)
    return Inspection(tuple(blur), found, groups, _jumps(n, found), same)


def blur_of(photo: Grey) -> float:
    """Perceptual blur in [0, 1] (Crete-Roffet et al. 2007): share of the differences between neighbouring pixels that
    a box filter of 9 pixels leaves, along the axis where more is left."""
    pixels = photo.astype(np.float32)
    found = []
    for axis, size in ((0, (1, 9)), (1, (9, 1))):
        sharp = np.abs(np.diff(pixels, axis=axis))
        blurred = np.abs(np.diff(cv2.blur(pixels, size), axis=axis))
        total = float(sharp.sum())
        found.append(1.0 if total == 0 else 1 - float(np.maximum(0, sharp - blurred).sum()) / total)
    return max(found)


def groups_of(count: int, pairs: Iterable[tuple[int, int]]) -> tuple[tuple[int, ...], ...]:
    """Connected components of `count` photos, the largest first."""
    label = list(range(count))

    def root(i: int) -> int:
        while label[i] != i:
            i = label[i]
        return i

    for i, j in pairs:
        label[root(i)] = root(j)
    groups: dict[int, list[int]] = {}
    for i in range(count):
        groups.setdefault(root(i), []).append(i)
    return tuple(sorted(map(tuple, groups.values()), key=len, reverse=True))


def _pair(i: int, j: int) -> tuple[int, int]:
    return min(i, j), max(i, j)


def _across(groups: Sequence[tuple[int, ...]], options: InspectionOptions) -> list[tuple[int, int]]:
    """Pairs that may join the groups: each photo of a smaller group with photos spread over the rest."""
    pairs: dict[tuple[int, int], None] = {}
    for group in groups[1:]:
        others = [i for other in groups if other is not group for i in other]
        spread = others[:: max(1, len(others) // options.candidates)]
        pairs |= {_pair(i, j): None for i in group for j in spread}
    return list(pairs)


def _features(sift: cv2.SIFT, photo: Grey) -> _Features:
    keypoints, descriptors = sift.detectAndCompute(photo, None)
    if descriptors is None or len(keypoints) == 0:
        return _Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32))
    points = np.array([keypoint.pt for keypoint in keypoints], np.float32)
    # Hellinger distance (RootSIFT, Arandjelovic and Zisserman 2012)
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-6))
    # display values to light: a power is enough for ratios
    light = cv2.blur((photo.astype(np.float32) / 255) ** 2.2, (9, 9))
    rows, columns = (points.astype(int)[:, k].clip(0, photo.shape[1 - k] - 1) for k in (1, 0))
    return _Features(points, descriptors.astype(np.float32), light[rows, columns])


def _link(features: Sequence[_Features], i: int, j: int, options: InspectionOptions) -> Link | None:
    """The verified matches of two photos; None where there are too few."""
    one, other = features[i], features[j]
    if min(len(one.points), len(other.points)) < options.link:
        return None
    cosine = one.descriptors @ other.descriptors.T
    rows = np.arange(len(cosine))
    best = cosine.argmax(1)
    nearest = cosine[rows, best]
    mutual = cosine.argmax(0)[best] == rows
    cosine[rows, best] = -1
    # of unit vectors the squared distance is 2 - 2 cos
    distinct = 1 - nearest < options.ratio**2 * (1 - cosine.max(1))
    kept = np.flatnonzero(mutual & distinct)
    if len(kept) < options.link:
        return None
    a, b = one.points[kept], other.points[best[kept]]
    verified = _verified(a, b, options)
    if verified.sum() < options.link:
        return None
    shift = float(np.median(np.linalg.norm(a - b, axis=1)[verified]))
    ratio = np.maximum(other.luminance[best[kept]], 1e-4) / np.maximum(one.luminance[kept], 1e-4)
    return Link(i, j, int(verified.sum()), shift, float(np.median(np.log2(ratio[verified]))))


def _verified(a: np.ndarray, b: np.ndarray, options: InspectionOptions) -> np.ndarray:
    """Which matches lie on their epipolar lines, or do not move at all, for which such lines are not defined."""
    still = np.linalg.norm(a - b, axis=1) < options.still_px
    if still.mean() > 0.5:
        return still
    cv2.setRNGSeed(0)
    try:
        _, inliers = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, options.epipolar_px, 0.999, 2000)
    except cv2.error:  # OpenCV 5 refuses some degenerate sets of points instead of finding nothing
        inliers = None
    return np.zeros(len(a), bool) if inliers is None else inliers[:, 0].astype(bool)


def _jumps(n: int, links: Sequence[Link]) -> tuple[float, ...]:
    """How much brighter each photo shows surfaces than the photos before and after it do, in the mean of both.

    Gloss changes smoothly from photo to photo, so that it cancels; a change of exposure does not.
    """
    before: list[list[float]] = [[] for _ in range(n)]
    after: list[list[float]] = [[] for _ in range(n)]
    for link in links:
        if link.second - link.first <= n // 2:
            before[link.second].append(link.stops)
            after[link.first].append(-link.stops)
    pairs = zip(before, after, strict=True)
    return tuple(0.5 * float(np.median(b) + np.median(a)) if a and b else 0.0 for b, a in pairs)
