"""What the figures of an inspection mean for a reconstruction: one finding per subject, and a verdict."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from splatgraft.capture.photo_inspection import Inspection
from splatgraft.capture.view_coverage import CoverageRule
from splatgraft.core.exposure import ConsistencyRule, Exposure, describe_inconsistency
from splatgraft.core.posed_images import LeftOut

Level = Literal["good", "doubtful", "unusable"]
_NAMED = 6
"""Photos that a finding names; it counts the others."""


@dataclass(frozen=True)
class Finding:
    """What was found on one subject."""

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
class FindingRule:
    """Limits; measured on the two captures that ship, two public ones and a rendered room."""

    fewest: int = CoverageRule().views
    """Photos: with fewer no surface is seen from enough sides."""
    few: int = 20
    """Photos; the 16 of the shipped bananas are near the limit."""
    blur_of_all: float = 0.5
    """Median blur. Sharp captures have 0.23 to 0.37; motion by 5 pixels at 640 lifts these to 0.4 to 0.54."""
    jump_stops: float = ConsistencyRule().most_stops
    """Brightness of a photo against those before and after; captures of fixed exposure have up to 0.31."""
    least_together: float = 0.5
    """Share of the photos that hang together: what structure from motion demands of poses."""


def find_in_sizes(sizes: Sequence[tuple[int, int]], names: Sequence[str]) -> Finding:
    """The number of photos of each size."""
    counts = Counter(sizes).most_common()
    main = counts[0][0]
    text = f"all {len(sizes)} photos have {main[0]} x {main[1]} px"
    if len(counts) == 1:
        return Finding("sizes", "good", text)
    odd = tuple(name for name, size in zip(names, sizes, strict=True) if size != main)
    text = f"{counts[0][1]} of {len(sizes)} photos have {main[0]} x {main[1]} px, {len(odd)} another: {named(odd)}"
    return Finding("sizes", "doubtful", text, "leave out those of another camera, zoom or orientation", odd)


def find_in_count(count: int, rule: FindingRule = FindingRule()) -> Finding:
    """Whether the photos are enough."""
    text = f"{count} photos"
    if count < rule.fewest:
        return Finding("count", "unusable", text, f"take at least {rule.few}, better 40 to 120")
    if count < rule.few:
        return Finding("count", "doubtful", f"{text}, which is few", "take 40 to 120 from all sides")
    return Finding("count", "good", text)


def find_in_odd_photos(odd: Sequence[LeftOut], count: int) -> Finding:
    """The photos that the command `capture` leaves out, of `count`; at least one."""
    names = tuple(Path(one.name).name for one in odd)
    level: Level = "unusable" if 2 * len(odd) > count else "doubtful"
    text = f"capture leaves out {len(odd)} of {count} photos: {named(names)}"
    # the reason begins with the file's whole path, which the text has named already
    why = odd[0].reason.removeprefix(f"{odd[0].name}: ")
    return Finding("left out", level, text, f"{names[0]}: {why}", names)


def find_in_photos(
    inspection: Inspection, names: Sequence[str], *, has_poses: bool, rule: FindingRule = FindingRule()
) -> tuple[Finding, ...]:
    """Sharpness, overlap, movement and brightness.

    Args:
        inspection: Of n photos.
        names: Of the photos.
        has_poses: Whether the photos have poses, so that no matches between them are needed.
        rule: Limits.
    """
    overlap = _overlap(inspection, names, rule)
    if has_poses and overlap.level != "good":
        overlap = Finding("overlap", "good", f"{overlap.text}; poses are given, which need none", photos=overlap.photos)
    return _sharpness(inspection, rule), overlap, _copies(inspection, names), _jumps(inspection, names, rule)


def find_in_exposures(exposures: Sequence[Exposure]) -> Finding:
    """What the cameras' settings say."""
    if all(one.ev100 is None for one in exposures):
        return Finding("settings", "good", "no exposure settings in EXIF, so that they cannot be compared")
    found = describe_inconsistency(exposures)
    if found is None:
        return Finding("settings", "good", f"one exposure for all photos: {exposures[0]}")
    return Finding("settings", "doubtful", found)


def verdict_of(findings: Sequence[Finding]) -> Level:
    """The worst of all levels."""
    levels = {finding.level for finding in findings}
    return "unusable" if "unusable" in levels else "doubtful" if "doubtful" in levels else "good"


def named(photos: Sequence[str]) -> str:
    """The first of some names, and how many more there are."""
    more = f" and {len(photos) - _NAMED} more" if len(photos) > _NAMED else ""
    return ", ".join(photos[:_NAMED]) + more


def _above(names: Sequence[str], values: Sequence[float], limit: float) -> tuple[str, ...]:
    """The names whose values are above a limit, the largest first."""
    pairs = sorted(zip(values, names, strict=True), key=lambda pair: -pair[0])
    return tuple(name for value, name in pairs if value > limit)


def _sharpness(inspection: Inspection, rule: FindingRule) -> Finding:
    blur = np.array(inspection.blur)
    middle = float(np.median(blur))
    if middle > rule.blur_of_all:
        text = f"most photos are blurred (median blur {middle:.2f}, sharp captures have 0.23 to 0.37)"
        return Finding("sharpness", "doubtful", text, "photograph again with shorter exposure and in focus")
    return Finding("sharpness", "good", f"the photos are sharp (blur {blur.min():.2f} to {blur.max():.2f})")


def _overlap(inspection: Inspection, names: Sequence[str], rule: FindingRule) -> Finding:
    n, largest = len(names), inspection.groups[0]
    next_to = [link.matches for link in inspection.links if link.second - link.first == 1]
    middle = f"{np.median(next_to):.0f}" if next_to else "no"
    if len(largest) == n:
        return Finding("overlap", "good", f"all photos hang together, {middle} matches between neighbours")
    apart = tuple(names[i] for group in inspection.groups[1:] for i in group)
    if len(largest) < rule.least_together * n:
        text = f"only {len(largest)} of {n} photos show one place together; the largest groups have "
        sizes = ", ".join(str(len(group)) for group in inspection.groups[:4])
        remedy = "take photos a step apart that share two thirds of the picture, with texture in view, of one place"
        return Finding("overlap", "unusable", text + sizes, remedy, apart)
    text = f"{len(apart)} of {n} photos show nothing in common with the rest: {named(apart)}"
    return Finding("overlap", "doubtful", text, "leave them out, or take photos between them and the rest", apart)


def _copies(inspection: Inspection, names: Sequence[str]) -> Finding:
    copies = tuple(names[i] for i in sorted({second for _, second in inspection.same}))
    if not copies:
        return Finding("movement", "good", "the camera moves from photo to photo")
    text = f"{len(copies)} of {len(names)} photos show the same as another from the same place: {named(copies)}"
    level: Level = "unusable" if 2 * len(copies) > len(names) else "doubtful"
    return Finding("movement", level, text, "leave copies out; walk around the subject", copies)


def _jumps(inspection: Inspection, names: Sequence[str], rule: FindingRule) -> Finding:
    jumps = [abs(jump) for jump in inspection.jumps]
    odd = _above(names, jumps, rule.jump_stops)
    if odd:
        text = f"{len(odd)} photos are up to {max(jumps):.1f} stops off their neighbours in brightness: {named(odd)}"
        return Finding("exposure", "doubtful", text, "lock exposure and white balance, or leave them out", odd)
    return Finding("exposure", "good", f"neighbours agree in brightness within {max(jumps):.2f} stops")
