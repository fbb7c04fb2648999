"""The command `check`: a quick test of a capture's photos before a long run."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from splatgraft.capture import geotag_notes, predict_pose_seconds, sun_by_clock, sun_heights
from splatgraft.capture.photo_inspection import (
    SIDE_PX,
    Finding,
    find_in_count,
    find_in_coverage,
    find_in_exposures,
    find_in_odd_photos,
    find_in_photos,
    find_in_sizes,
)
from splatgraft.capture.usable_views import find_odd_photos
from splatgraft.capture.video import grey_frames
from splatgraft.core.cameras import Cameras
from splatgraft.core.images import read_exif, read_grey, stored_size
from splatgraft.folders.capture_files import has_poses
from splatgraft.folders.clock_sun import read_clock_sun
from splatgraft.folders.input_description import require_input
from splatgraft.formats import is_scene, read_capture, read_gaussians
from splatgraft.formats.captures.exif import read_exposure, read_geotag
from splatgraft.formats.captures.masks import PhotoFiles, find_photos
from splatgraft.formats.captures.photo_archive import is_archive, unpack_photos
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console

_FRAMES = 40  # frames examined in a video; the command `capture` takes 120
_DRAFT_SECONDS = 45.0  # to a draft of any size on two idle cores
_FOCAL_LENGTH = 0x920A  # EXIF tag


@dataclass(frozen=True)
class Check:
    """Examine a capture in seconds, before a long run. Exit status: 0 usable, 1 not usable."""

    capture: Positional
    """A folder or a .zip of photos, a video, a COLMAP folder, a folder with transforms.json, or a trained scene."""
    json: bool = False
    """Print the findings as JSON on standard output."""

    def execute(self, console: Console) -> int:
        """Print one line per subject and a verdict."""
        findings = list(self._findings(console))
        verdict = next((level for level in _VERDICTS if level in {finding.level for finding in findings}), "good")
        if self.json:
            found = [asdict(finding) for finding in findings]
            console.result(json.dumps({"capture": str(self.capture), "verdict": verdict, "findings": found}, indent=1))
        else:
            for finding in findings:
                console.result(f"{finding.level:<9} {finding.subject:<10} {finding}")
            console.result(f"verdict: {_VERDICTS[verdict]}")
        return 1 if verdict == "unusable" else 0

    def _findings(self, console: Console) -> Iterator[Finding]:
        require_input(self.capture)
        if is_archive(self.capture):
            with TemporaryDirectory() as folder:
                unpacked = unpack_photos(self.capture, Path(folder) / self.capture.stem)
                yield from replace(self, capture=unpacked)._findings(console)
            return
        if is_scene(self.capture):
            count = read_gaussians(self.capture).count
            yield Finding("scene", "good", f"a trained scene of {count:,} Gaussians: no photos to look at")
            return
        if self.capture.is_file() and not has_poses(self.capture):
            yield from self._of_video(console)
            return
        posed = read_capture(self.capture) if has_poses(self.capture) else None
        photos = find_photos(self.capture) if posed is None else PhotoFiles(posed.image_paths, posed.mask_paths)
        with console.bar("check") as progress:
            odd = find_odd_photos(photos.paths, progress=progress)
        left_out = {Path(one.name) for one in odd}
        used = [path for path in photos.paths if path not in left_out]
        if odd:
            yield find_in_odd_photos(odd, len(photos.paths))
        yield find_in_count(len(used))
        if len(used) < 2:
            return
        names = [path.name for path in used]
        yield find_in_sizes([stored_size(path) for path in used], names)
        with console.bar("check") as progress:
            greys = (read_grey(path, SIDE_PX) for path in used)
            yield from find_in_photos(greys, names, has_poses=posed is not None, progress=progress)
        yield find_in_exposures([read_exposure(path) for path in used])
        yield _lens(used)
        kept = [path not in left_out for path in photos.paths]
        yield from _sun(self.capture, used, None if posed is None else posed.cameras[torch.tensor(kept)])
        if posed is not None:
            yield Finding("poses", "good", f"given for {len(posed)} images, with {len(posed.points)} points")
            yield find_in_coverage(posed.cameras)
        else:
            yield Finding("poses", "good", "none: structure from motion finds them")
        yield _masks(sum(path is not None for path in photos.masks))
        yield _time(0 if posed is not None else len(used))

    def _of_video(self, console: Console) -> Iterator[Finding]:
        frames = grey_frames(self.capture, _FRAMES, SIDE_PX)
        names = [f"frame {i + 1} of {len(frames)}" for i in range(len(frames))]
        yield Finding("video", "good", f"{len(frames)} frames spread over it were examined")
        with console.bar("check") as progress:
            # these frames are three times as far apart as those of `capture`, so they need not overlap
            yield from find_in_photos(frames, names, has_poses=True, progress=progress)
        yield _masks(0)
        yield _time(3 * len(frames))


_VERDICTS = {
    "unusable": "not usable; mend the points marked unusable first",
    "doubtful": "usable, but the doubtful points above may cost quality",
    "good": "good to go",
}
"""Verdict by the worst level of all findings."""


def _lens(photos: Sequence[Path]) -> Finding:
    known = sum(_FOCAL_LENGTH in read_exif(photo) for photo in photos)
    estimated = "all photos" if known == len(photos) else f"{known} of {len(photos)} photos; estimated for the others"
    return Finding("lens", "good", f"focal length in EXIF of {estimated}")


def _sun(capture: Path, photos: Sequence[Path], cameras: Cameras | None) -> Iterator[Finding]:
    """Find the sun by time and place of the photos, its direction only if they have poses."""
    tags = [read_geotag(photo) for photo in photos]
    if cameras is None:
        said = "; or ".join(one.describe() for one in sun_heights(tags))
    else:
        sun = read_clock_sun(capture) or sun_by_clock(tags, cameras)
        said = "" if sun is None else sun.describe(cameras)
    notes = [note.text for note in geotag_notes(tags, [photo.name for photo in photos])]
    for text in [said, *notes] if said else notes:
        yield Finding("sun", "good", text)


def _masks(count: int) -> Finding:
    text = f"{count} masks" if count else "none; a place needs none, and an object is cut out by a box or clicks"
    return Finding("masks", "good", text)


def _time(photos_to_pose: int) -> Finding:
    posing = predict_pose_seconds(photos_to_pose)
    minutes = (posing + _DRAFT_SECONDS) / 60
    poses = f", including {_minutes(posing / 60)} for the poses" if photos_to_pose else ""
    return Finding("time", "good", f"about {_minutes(minutes)} to a draft on two idle cores{poses}")


def _minutes(minutes: float) -> str:
    return f"{minutes:.0f} minutes" if minutes >= 1.5 else "1 minute"


COMMAND = Check
