"""Inspection of photos before structure from motion: sharpness, overlap and exposure, from small grey versions.

- Sharpness is that of `usable_views.log_sharpness`.
- Overlap is the number of SIFT matches (Lowe 2004: ratio test) that satisfy the epipolar geometry (USAC, MAGSAC++).
  Photos are matched with those that follow in the order of names. Photos that these matches leave unconnected are
  matched with the photos whose largest features match best.
- Exposure is compared between neighbours at their matches, because a surface should have the same brightness in both.
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

from splatgraft.capture.structure_from_motion import MIN_POSED_SHARE
from splatgraft.capture.usable_views import MIN_VIEWS, log_sharpness, past_subject
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import WIDE_GAP_DEG, focus_point, widest_gap
from splatgraft.core.exposure import Exposure, describe_inconsistency
from splatgraft.core.posed_images import LeftOut
from splatgraft.runtime.progress import Progress, silent

SIDE_PX = 640
"""Longest side of the grey versions, pixels: that of a draft reconstruction."""
_FEATURES = 1200  # strongest SIFT features kept per photo
_NEIGHBOURS = 3  # following photos in name order (cyclic) with which each photo is matched
_RATIO = 0.8  # largest distance of the best match over that of the second (Lowe 2004)
_EPIPOLAR_PX = 1.5  # largest distance of a match from its epipolar line
_MIN_MATCHES = 15  # fewest verified matches between two photos of the same place (COLMAP: min_num_inliers)
_PARTNERS = 4  # photos of any position with which a photo unconnected to its neighbours is matched
_PARTNER_FEATURES = 300  # largest features of a photo by which partners are found (Wu 2013, section 3)
_STILL_PX = 0.5  # largest shift of a match without camera motion: less than a hand can hold still

# limits of the findings, measured on the two captures that ship, two public ones and a rendered room
_FEW = 20  # photos; the 16 of the shipped bananas are near the limit
_SHARP_MEDIAN = -1.8
"""Smallest median sharpness of a sharp capture, octaves. Ten captures (seven photographed, three rendered) have -1.2 to
0.6; with motion blur of 9 px at 640 px, -3.6 to -1.8."""
_JUMP_STOPS = 0.4  # largest brightness difference from both neighbours; captures of fixed exposure have up to 0.31
_NAMED = 6  # most photos that a finding names

Grey = UInt8[np.ndarray, "h w"]
"""sRGB luma of a photo."""
Level = Literal["good", "doubtful", "unusable"]


@dataclass(frozen=True)
class Finding:
    """Result of an inspection on one subject."""

    subject: str
    """Subject in one word, such as "overlap"."""
    level: Level
    """Suitability for a reconstruction."""
    text: str
    """Observation, one line."""
    remedy: str = ""
    """Advice, one line; empty if nothing needs to be done."""
    photos: tuple[str, ...] = ()
    """Names of the affected photos."""

    def __str__(self) -> str:
        """Return observation and advice in one line."""
        return self.text + (f"; {self.remedy}" if self.remedy else "")


@dataclass(frozen=True)
class _Features:
    """SIFT features of one photo, the largest first."""

    points: np.ndarray
    descriptors: np.ndarray
    luminance: np.ndarray


@dataclass(frozen=True)
class _Link:
    """Two photos, by index, that show the same place."""

    first: int
    second: int
    matches: int
    """Number of verified matches."""
    stops: float
    """Median brightness of the second photo over the first at the matches, stops."""


def find_in_photos(
    photos: Iterable[Grey], names: Sequence[str], *, has_poses: bool, progress: Progress = silent
) -> tuple[Finding, ...]:
    """Inspect sharpness, overlap and exposure of photos, which are read one at a time.

    Args:
        photos: Luma in the order in which the photos were taken, the longest side at most `SIDE_PX`.
        names: Names of the photos.
        has_poses: Whether the photos have poses and so need no matches.
        progress: Called with photos done, photos in all and a short text.
    """
    sharpness: list[float] = []
    features: list[_Features] = []
    n, sift = len(names), cv2.SIFT.create(nfeatures=_FEATURES)
    for index, photo in enumerate(photos):
        sharpness.append(log_sharpness(photo.astype(np.float32)))
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
    return _sharpness(sharpness), overlap, _exposure(links, names)


def _groups(count: int, found: Mapping[tuple[int, int], _Link | None]) -> list[list[int]]:
    """Return the connected components of the photos under their links, the largest first."""
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
    # display values to linear light; a power is accurate enough for ratios
    light = cv2.blur((photo.astype(np.float32) / 255) ** 2.2, (9, 9))
    rows, columns = (points.astype(int)[:, k].clip(0, photo.shape[1 - k] - 1) for k in (1, 0))
    return _Features(points, descriptors.astype(np.float32), light[rows, columns])


def _partners(features: Sequence[_Features], i: int, others: Sequence[int]) -> list[int]:
    """Return the photos among `others` whose largest features match those of photo `i` best, the best first."""
    largest = [features[j].descriptors[:_PARTNER_FEATURES] for j in others]
    # one product for all costs less than many small ones
    cosines = features[i].descriptors[:_PARTNER_FEATURES] @ np.concatenate(largest).T
    ends = np.cumsum([len(one) for one in largest])[:-1]
    counted = {
        j: len(_distinct(cosine)[0]) if min(cosine.shape) > 1 else 0
        for j, cosine in zip(others, np.split(cosines, ends, axis=1), strict=True)
    }
    return sorted((j for j in others if counted[j]), key=lambda j: -counted[j])[:_PARTNERS]


def _distinct(cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows and columns of mutual nearest neighbours that pass the ratio test, given unit vectors' cosines.

    The largest value of each row is overwritten.
    """
    rows = np.arange(len(cosine))
    best = cosine.argmax(1)
    nearest = cosine[rows, best]
    mutual = cosine.argmax(0)[best] == rows
    cosine[rows, best] = -1
    # the squared distance of unit vectors is 2 - 2 cos
    kept = np.flatnonzero(mutual & (1 - nearest < _RATIO**2 * (1 - cosine.max(1))))
    return kept, best[kept]


def _link(features: Sequence[_Features], i: int, j: int) -> _Link | None:
    """Match two photos and verify the matches; None if these are too few."""
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
    """Test which matches lie on their epipolar lines, or, if most do not move and these are undefined, do not move."""
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
    """Compare the sizes of photos; portrait and landscape count as one size."""
    # a camera takes both
    (width, height), most = Counter((max(size), min(size)) for size in sizes).most_common(1)[0]
    odd = tuple(name for name, size in zip(names, sizes, strict=True) if (max(size), min(size)) != (width, height))
    if not odd:
        return Finding("sizes", "good", f"all {len(sizes)} photos have {width} x {height} px")
    text = f"{most} of {len(sizes)} photos have {width} x {height} px, {len(odd)} another size: {_named(odd)}"
    return Finding("sizes", "doubtful", text, "use one camera and one zoom setting; capture keeps all that fit", odd)


def find_in_exposures(exposures: Sequence[Exposure]) -> Finding:
    """Compare the exposure settings in EXIF."""
    if all(one.ev100 is None for one in exposures):
        return Finding("settings", "good", "EXIF has no exposure settings to compare")
    differs = describe_inconsistency(exposures)
    return Finding(
        "settings",
        "good" if differs is None else "doubtful",
        differs or f"one exposure for all photos: {exposures[0]}",
    )


def find_in_count(count: int) -> Finding:
    """Judge the number of photos."""
    text = f"{count} photos"
    if count < MIN_VIEWS:
        return Finding("count", "unusable", text, f"take at least {_FEW}, better 40 to 120")
    if count < _FEW:
        return Finding("count", "doubtful", f"{text}, fewer than {_FEW}", "take 40 to 120 from all sides")
    return Finding("count", "good", text)


def find_in_coverage(cameras: Cameras) -> Finding:
    """Measure the part of the circle around their common focus point that posed photos cover."""
    try:
        gap, (first, last) = widest_gap(cameras, focus_point(cameras))
    except ValueError:  # no common focus point
        return Finding("coverage", "good", "the photos look outwards: a place, without an object to cut out")
    text = f"the photos cover {360 - gap:.0f} of 360 degrees around their subject"
    past = [name for name, is_past in zip(cameras.names, past_subject(cameras).tolist(), strict=True) if is_past]
    text += f"; {len(past)} do not show it: {_named(past)}" if past else ""
    if gap < WIDE_GAP_DEG:
        return Finding("coverage", "good", text)
    remedy = "photograph an object from there, too, or its back is guessed; a place needs no such photos"
    return Finding("coverage", "good" if gap < 180 else "doubtful", f"{text}, none between {first} and {last}", remedy)


def find_in_odd_photos(odd: Sequence[LeftOut], count: int) -> Finding:
    """Report the photos, at least one of `count`, that the command `capture` leaves out."""
    names = tuple(Path(one.name).name for one in odd)
    level: Level = "unusable" if 2 * len(odd) > count else "doubtful"
    text = f"capture leaves out {len(odd)} of {count} photos: {_named(names)}"
    # the reason begins with the full path, and the text has named the file
    why = odd[0].reason.removeprefix(f"{odd[0].name}: ")
    return Finding("left out", level, text, f"{names[0]}: {why}", names)


def _named(photos: Sequence[str]) -> str:
    """List the first names, and the number of further ones."""
    more = f" and {len(photos) - _NAMED} more" if len(photos) > _NAMED else ""
    return ", ".join(photos[:_NAMED]) + more


def _sharpness(sharpness: Sequence[float]) -> Finding:
    known = np.array(sharpness)[np.isfinite(sharpness)]
    if not len(known):
        text = "the photos are too plain or too small to measure sharpness"
        return Finding("sharpness", "doubtful", text, "take larger photos with texture in view")
    middle = float(np.median(known))
    if middle < _SHARP_MEDIAN:
        text = f"most photos are blurred (fine over coarse detail {2**middle:.2f}, sharp captures have 0.44 to 1.5)"
        return Finding("sharpness", "doubtful", text, "photograph again with shorter exposure and in focus")
    low, high = 2 ** known.min(), 2 ** known.max()
    return Finding("sharpness", "good", f"the photos are sharp (fine over coarse detail {low:.2f} to {high:.2f})")


def _overlap(found: Mapping[tuple[int, int], _Link | None], names: Sequence[str]) -> Finding:
    groups, n = _groups(len(names), found), len(names)
    largest = groups[0]
    next_to = [link.matches for link in found.values() if link is not None and link.second - link.first == 1]
    middle = f"{np.median(next_to):.0f}" if next_to else "no"
    if len(largest) == n:
        return Finding("overlap", "good", f"all photos are connected, {middle} matches between neighbours")
    apart = tuple(names[i] for group in groups[1:] for i in group)
    if len(largest) < MIN_POSED_SHARE * n:
        text = f"only {len(largest)} of {n} photos show one place together; photos in the largest groups: "
        sizes = ", ".join(str(len(group)) for group in groups[:4])
        remedy = "take photos of one place, a step apart, with two thirds overlap and texture in view"
        return Finding("overlap", "unusable", text + sizes, remedy, apart)
    text = f"{len(apart)} of {n} photos share little with the others and may get no pose: {_named(apart)}"
    # structure from motion has more features, so these photos may still get a pose and connect others
    return Finding("overlap", "doubtful", text, "keep them, and take photos between them and the rest", apart)


def _exposure(links: Sequence[_Link], names: Sequence[str]) -> Finding:
    """Find photos that are brighter or darker than the photos before and after them, at the matches of neighbours.

    Gloss changes smoothly from photo to photo and so cancels; a change of exposure does not.
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
        text = f"brightness of {len(odd)} photos differs from neighbours by up to {max(jumps):.1f} stops: {_named(odd)}"
        return Finding("exposure", "doubtful", text, "lock exposure and white balance next time", odd)
    return Finding("exposure", "good", f"the brightness of neighbours agrees within {max(jumps):.2f} stops")
