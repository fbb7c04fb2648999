"""What photos tell before poses are sought: sharpness, overlap and brightness, from small grey versions.

Overlap is counted in SIFT matches (Lowe 2004: ratio test), verified by epipolar geometry (USAC, MAGSAC++), between
photos that follow one another; what these do not hold together is compared, as structure from motion does it, with the
photos that share most of the largest features, wherever in the order they are. The matches of neighbours tell the
exposure of each photo against the others, as one surface should have one brightness. Sharpness is the perceptual blur
metric of Crete-Roffet et al. 2007, which depends little on what is shown: how much the picture loses when it is blurred
once more.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from splatgraft.capture.usable_views import MIN_VIEWS
from splatgraft.core.exposure import Exposure, describe_inconsistency
from splatgraft.core.posed_images import LeftOut
from splatgraft.runtime.progress import Progress, silent

SIDE_PX = 640
"""Longest side of the grey versions: that of a draft reconstruction."""
_FEATURES = 1200  # SIFT features per photo, the strongest
_NEIGHBOURS = 3  # photos that follow in the order of names (in a ring) with which each is matched
_RATIO = 0.8  # distance of the best match over that of the second, at most (Lowe 2004)
_EPIPOLAR_PX = 1.5  # distance of a match from its epipolar line, at most
_MIN_MATCHES = 15  # verified matches from which two photos show the same place: what COLMAP demands (min_num_inliers)
_PARTNERS = 4  # photos anywhere in the order with which a photo is matched that its neighbours do not hold
_PARTNER_FEATURES = 300
"""Largest features of a photo by which its partners are found (preemptive matching: Wu 2013, section 3)."""
_STILL_PX = 0.5  # shift below which a match does not move: below what a hand can hold still

# limits of the findings, measured on the two captures that ship, two public ones and a rendered room
_FEW = 20  # photos; the 16 of the shipped bananas are near the limit
_BLUR_OF_ALL = 0.5
"""Median blur. Sharp captures have 0.23 to 0.37; motion by 5 pixels at 640 lifts these to 0.4 to 0.54."""
_JUMP_STOPS = 0.4
"""Brightness of a photo against those before and after, as of the exposure settings; captures of fixed exposure have up
to 0.31."""
_MIN_TOGETHER = 0.5  # share of the photos that hang together: what structure from motion demands of poses
_NAMED = 6  # photos that a finding names; it counts the others

Grey = UInt8[np.ndarray, "h w"]
"""sRGB luma."""
Level = Literal["good", "doubtful", "unusable"]


@dataclass(frozen=True)
class Finding:
    """What was found on one subject, and what it means for a reconstruction."""

    subject: str
    """One word, such as "overlap"."""
    level: Level
    """What it means for a reconstruction."""
    text: str
    """What was found, on one line."""
    remedy: str = ""
    """What to do, on one line; empty where nothing need be done."""
    photos: tuple[str, ...] = ()
    """Names of the photos that it is about."""

    def __str__(self) -> str:
        """One line for people."""
        return self.text + (f"; {self.remedy}" if self.remedy else "")


@dataclass(frozen=True)
class _Features:
    """Of one photo, the largest first."""

    points: np.ndarray
    descriptors: np.ndarray
    luminance: np.ndarray


@dataclass(frozen=True)
class _Link:
    """Two photos, by index, that show the same place."""

    first: int
    second: int
    matches: int
    """Verified."""
    stops: float
    """How much brighter the second photo shows the same surfaces, median over matches."""


def find_in_photos(
    photos: Iterable[Grey], names: Sequence[str], *, has_poses: bool, progress: Progress = silent
) -> tuple[Finding, ...]:
    """Sharpness, overlap and brightness of photos in the order in which they were taken, read one at a time.

    Their longest side is `SIDE_PX` at most. Photos that have poses need no matches.
    """
    blur: list[float] = []
    features: list[_Features] = []
    n, sift = len(names), cv2.SIFT.create(nfeatures=_FEATURES)
    for index, photo in enumerate(photos):
        blur.append(blur_of(photo))
        features.append(_features(sift, photo))
        progress(index + 1, n, "looking at photos")
    found: dict[tuple[int, int], _Link | None] = {}

    def match(one: int, other: int) -> None:
        pair = min(one, other), max(one, other)
        if one != other and pair not in found:
            found[pair] = _link(features, *pair)

    for index in range(n):
        for step in range(1, min(_NEIGHBOURS, n - 1) + 1):
            match(index, (index + step) % n)
        progress(index + 1, n, "comparing neighbours")
    apart = [(i, group) for group in _groups(n, found)[1:] for i in group]
    for done, (i, group) in enumerate(apart, 1):
        for j in _partners(features, i, [k for k in range(n) if k not in group]):
            match(i, j)
        progress(done, len(apart), "looking for partners")
    links = [link for pair, link in found.items() if link is not None and pair[1] - pair[0] <= _NEIGHBOURS]
    overlap = _overlap(found, names)
    if has_poses and overlap.level != "good":
        overlap = Finding("overlap", "good", f"{overlap.text}; poses are given, which need none", photos=overlap.photos)
    return _sharpness(blur), overlap, _exposure(links, names)


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


def _groups(count: int, found: Mapping[tuple[int, int], _Link | None]) -> list[list[int]]:
    """Photos that hang together by links, the largest group first."""
    rows = np.array([pair for pair, link in found.items() if link is not None], int).reshape(-1, 2)
    graph = coo_array((np.ones(len(rows), bool), (rows[:, 0], rows[:, 1])), shape=(count, count))
    number, label = connected_components(graph, directed=False)
    return sorted((np.flatnonzero(label == k).tolist() for k in range(number)), key=len, reverse=True)


def _features(sift: cv2.SIFT, photo: Grey) -> _Features:
    keypoints, descriptors = sift.detectAndCompute(photo, None)
    if descriptors is None or len(keypoints) == 0:
        return _Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32))
    largest = np.argsort([-keypoint.size for keypoint in keypoints], kind="stable")
    points, descriptors = np.array([keypoints[k].pt for k in largest], np.float32), descriptors[largest]
    # Hellinger distance (RootSIFT, Arandjelovic and Zisserman 2012)
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-6))
    # display values to light: a power is enough for ratios
    light = cv2.blur((photo.astype(np.float32) / 255) ** 2.2, (9, 9))
    rows, columns = (points.astype(int)[:, k].clip(0, photo.shape[1 - k] - 1) for k in (1, 0))
    return _Features(points, descriptors.astype(np.float32), light[rows, columns])


def _partners(features: Sequence[_Features], i: int, others: Sequence[int]) -> list[int]:
    """Those of `others` whose largest features match those of photo `i` best, the best first."""
    largest = [features[j].descriptors[:_PARTNER_FEATURES] for j in others]
    # one product for all, since many small ones cost more
    cosines = features[i].descriptors[:_PARTNER_FEATURES] @ np.concatenate(largest).T
    ends = np.cumsum([len(one) for one in largest])[:-1]
    counted = {
        j: len(_distinct(cosine)[0]) if min(cosine.shape) > 1 else 0
        for j, cosine in zip(others, np.split(cosines, ends, axis=1), strict=True)
    }
    return sorted((j for j in others if counted[j]), key=lambda j: -counted[j])[:_PARTNERS]


def _distinct(cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows and columns of cosines of unit vectors that are nearest to each other and much nearer than the second.

    The best of each row is overwritten.
    """
    rows = np.arange(len(cosine))
    best = cosine.argmax(1)
    nearest = cosine[rows, best]
    mutual = cosine.argmax(0)[best] == rows
    cosine[rows, best] = -1
    # of unit vectors the squared distance is 2 - 2 cos
    kept = np.flatnonzero(mutual & (1 - nearest < _RATIO**2 * (1 - cosine.max(1))))
    return kept, best[kept]


def _link(features: Sequence[_Features], i: int, j: int) -> _Link | None:
    """The verified matches of two photos; None where there are too few."""
    one, other = features[i], features[j]
    if min(len(one.points), len(other.points)) < _MIN_MATCHES:
        return None
    kept, best = _distinct(one.descriptors @ other.descriptors.T)
    if len(kept) < _MIN_MATCHES:
        return None
    a, b = one.points[kept], other.points[best]
    verified = _verified(a, b)
    if verified.sum() < _MIN_MATCHES:
        return None
    ratio = np.maximum(other.luminance[best], 1e-4) / np.maximum(one.luminance[kept], 1e-4)
    return _Link(i, j, int(verified.sum()), float(np.median(np.log2(ratio[verified]))))


def _verified(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Which matches lie on their epipolar lines, or do not move at all, for which such lines are not defined."""
    still = np.linalg.norm(a - b, axis=1) < _STILL_PX
    if still.mean() > 0.5:
        return still
    cv2.setRNGSeed(0)
    try:
        _, inliers = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, _EPIPOLAR_PX, 0.999, 2000)
    except cv2.error:  # OpenCV 5 refuses some degenerate sets of points instead of finding nothing
        inliers = None
    return np.zeros(len(a), bool) if inliers is None else inliers[:, 0].astype(bool)


def find_in_sizes(sizes: Sequence[tuple[int, int]], names: Sequence[str]) -> Finding:
    """The number of photos of each size, upright or on the side."""
    # a photo held on its side is of the same camera
    (width, height), most = Counter((max(size), min(size)) for size in sizes).most_common(1)[0]
    odd = tuple(name for name, size in zip(names, sizes, strict=True) if (max(size), min(size)) != (width, height))
    if not odd:
        return Finding("sizes", "good", f"all {len(sizes)} photos have {width} x {height} px")
    text = f"{most} of {len(sizes)} photos have {width} x {height} px, {len(odd)} another: {_named(odd)}"
    return Finding("sizes", "doubtful", text, "one camera and one zoom are best; capture uses all that fit", odd)


def find_in_exposures(exposures: Sequence[Exposure]) -> Finding:
    """What the cameras' settings say."""
    if all(one.ev100 is None for one in exposures):
        return Finding("settings", "good", "no exposure settings in EXIF, so that they cannot be compared")
    differs = describe_inconsistency(exposures)
    return Finding(
        "settings",
        "good" if differs is None else "doubtful",
        differs or f"one exposure for all photos: {exposures[0]}",
    )


def find_in_count(count: int) -> Finding:
    """Whether the photos are enough."""
    text = f"{count} photos"
    if count < MIN_VIEWS:
        return Finding("count", "unusable", text, f"take at least {_FEW}, better 40 to 120")
    if count < _FEW:
        return Finding("count", "doubtful", f"{text}, which is few", "take 40 to 120 from all sides")
    return Finding("count", "good", text)


def find_in_odd_photos(odd: Sequence[LeftOut], count: int) -> Finding:
    """The photos that the command `capture` leaves out, of `count`; at least one."""
    names = tuple(Path(one.name).name for one in odd)
    level: Level = "unusable" if 2 * len(odd) > count else "doubtful"
    text = f"capture leaves out {len(odd)} of {count} photos: {_named(names)}"
    # the reason begins with the file's whole path, which the text has named already
    why = odd[0].reason.removeprefix(f"{odd[0].name}: ")
    return Finding("left out", level, text, f"{names[0]}: {why}", names)


def _named(photos: Sequence[str]) -> str:
    """The first of some names, and how many more there are."""
    more = f" and {len(photos) - _NAMED} more" if len(photos) > _NAMED else ""
    return ", ".join(photos[:_NAMED]) + more


def _sharpness(blur: Sequence[float]) -> Finding:
    middle = float(np.median(blur))
    if middle > _BLUR_OF_ALL:
        text = f"most photos are blurred (median blur {middle:.2f}, sharp captures have 0.23 to 0.37)"
        return Finding("sharpness", "doubtful", text, "photograph again with shorter exposure and in focus")
    return Finding("sharpness", "good", f"the photos are sharp (blur {min(blur):.2f} to {max(blur):.2f})")


def _overlap(found: Mapping[tuple[int, int], _Link | None], names: Sequence[str]) -> Finding:
    groups, n = _groups(len(names), found), len(names)
    largest = groups[0]
    next_to = [link.matches for link in found.values() if link is not None and link.second - link.first == 1]
    middle = f"{np.median(next_to):.0f}" if next_to else "no"
    if len(largest) == n:
        return Finding("overlap", "good", f"all photos hang together, {middle} matches between neighbours")
    apart = tuple(names[i] for group in groups[1:] for i in group)
    if len(largest) < _MIN_TOGETHER * n:
        text = f"only {len(largest)} of {n} photos show one place together; the largest groups have "
        sizes = ", ".join(str(len(group)) for group in groups[:4])
        remedy = "take photos a step apart that share two thirds of the picture, with texture in view, of one place"
        return Finding("overlap", "unusable", text + sizes, remedy, apart)
    text = f"{len(apart)} of {n} photos share little with the others and may get no pose: {_named(apart)}"
    # more features may still hold them, and they then hold others
    return Finding("overlap", "doubtful", text, "keep them, and take photos between them and the rest", apart)


def _exposure(links: Sequence[_Link], names: Sequence[str]) -> Finding:
    """By links of neighbours, how much brighter each photo shows surfaces than those before and after it do.

    Gloss changes smoothly from photo to photo, so that it cancels; a change of exposure does not.
    """
    before: list[list[float]] = [[] for _ in names]
    after: list[list[float]] = [[] for _ in names]
    for link in links:
        before[link.second].append(link.stops)
        after[link.first].append(-link.stops)
    pairs = zip(before, after, strict=True)
    jumps = [abs(0.5 * float(np.median(b) + np.median(a))) if a and b else 0.0 for b, a in pairs]
    largest_first = sorted(range(len(names)), key=lambda i: -jumps[i])
    odd = tuple(names[i] for i in largest_first if jumps[i] > _JUMP_STOPS)
    if odd:
        text = f"{len(odd)} photos are up to {max(jumps):.1f} stops off their neighbours in brightness: {_named(odd)}"
        return Finding("exposure", "doubtful", text, "lock exposure and white balance next time", odd)
    return Finding("exposure", "good", f"neighbours agree in brightness within {max(jumps):.2f} stops")
