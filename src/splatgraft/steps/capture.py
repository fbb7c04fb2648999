"""The command `capture`: make a folder with transforms.json of photos, a video, poses or a trained scene."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

from splatgraft.capture import (
    PoseOptions,
    VirtualCameraOptions,
    extract_frames,
    geotag_notes,
    place_virtual_cameras,
    pose_photos,
    read_doubts,
    require_coverage,
    sun_by_clock,
    usable_masks,
    usable_photos,
    usable_views,
    write_pose_report,
    write_reduced,
)
from splatgraft.capture.photo_inspection import find_in_coverage
from splatgraft.core.cameras import Cameras
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.folders.capture_files import (
    capture_inputs,
    description_files,
    exposure_notes,
    has_poses,
    left_out_notes,
    unposed_notes,
)
from splatgraft.folders.clock_sun import clock_sun_path, read_clock_sun, write_clock_sun
from splatgraft.formats import is_scene, read_capture, read_scene, scene_files, write_capture
from splatgraft.formats.captures import read_given_poses
from splatgraft.formats.captures.exif import read_geotag
from splatgraft.formats.captures.masks import PhotoFiles, describe_masks, find_photos
from splatgraft.formats.captures.photo_archive import is_archive, unpack_photos
from splatgraft.project.metric_scale import MetricScale, write_scale
from splatgraft.project.step import Context, Inputs, Positional
from splatgraft.rendering import render
from splatgraft.runtime.note import Note


@dataclass(frozen=True)
class Capture:
    """Pose photos or a video. Existing poses are taken over, and their images are referred to. A trained scene without
    photographs is rendered from all around."""

    remedy: ClassVar[str] = (
        "add or replace the photos named, or take more, sharper and with more overlap: splatgraft check PHOTOS"
    )

    capture: Positional
    """A folder or a .zip of photos, a video, a COLMAP folder, a folder with transforms.json, or a trained scene (.ply,
    .spz, .splat, .sog, .glb, .ksplat)."""
    out: Path = Path("capture")
    """Folder for transforms.json, points.ply and clock_sun.json."""
    poses: Path | None = None
    """Poses that another program found for photos: a COLMAP folder or a transforms.json."""
    max_side: int = 1600
    """Longest side of the images in all later steps, pixels; larger ones are reduced once and stored in the result; 0
    keeps all sizes."""
    keep_odd: bool = False
    """Whether blurred photos and copies of other photos are used; otherwise they are named and left out."""
    accept_doubtful: bool = False
    """Whether `run` continues with poses that are not plausible; otherwise it stops after this step."""
    clock_sun: bool = True
    """Whether the sun's direction by the photos' time, place and compass is kept in clock_sun.json, which is never
    exported."""
    axes: str | None = None
    """Directions of x, y and z of a trained scene (RDF: right, down, front), if those of its format are wrong."""
    options: PoseOptions = field(default_factory=PoseOptions)
    look: VirtualCameraOptions = field(default_factory=VirtualCameraOptions)

    def inputs(self) -> Inputs:
        """Return the photos, the video, the scene, or the files of the posed capture."""
        if is_scene(self.capture):
            return {"photos": scene_files(self.capture)}
        if self.poses is None and has_poses(self.capture):
            sun = clock_sun_path(self.capture)
            files = capture_inputs(self.capture, read_capture(self.capture), masks=True)
            return files | {"sun": (sun,)} if sun.is_file() else files
        files = {"photos": (self.capture,)}
        if self.capture.is_dir():
            photos = find_photos(self.capture)
            files = {"photos": photos.paths, "masks": tuple(mask for mask in photos.masks if mask is not None)}
        elif self.poses is not None and not is_archive(self.capture):
            raise ValueError(f"{self.capture}: expected a folder or a .zip of photos beside --poses, found neither")
        return files if self.poses is None else files | {"poses": description_files(self.poses)}

    def write(self, folder: Path, context: Context) -> None:
        """Write the posed capture."""
        if self.poses is not None:
            posed = self._with_given_poses(self.poses, folder, context)
            originals = posed.image_paths
        elif is_scene(self.capture):
            posed = self._pictures(folder, context)
            originals = ()
        elif has_poses(self.capture):
            posed = self._taken_over(context)
            originals = posed.image_paths
            context.console.tell(*exposure_notes(self.capture, posed.image_paths))
            if self.max_side > 0:
                posed = write_reduced(posed, folder, self.max_side, progress=context.progress)
        else:
            photos = self._photos(folder, context)
            context.console.tell(*exposure_notes(self.capture, photos.paths))
            posed, report = pose_photos(
                photos,
                folder,
                scratch=context.checkpoint.folder / "colmap",
                options=self.options,
                progress=context.progress,
                say=lambda sentence: context.console.say(f"{self.capture}: {sentence}"),
            )
            context.console.say(f"{self.capture}: {report}")
            context.console.tell(*(Note(f"{self.capture}: doubtful: {d}", "warning") for d in report.doubts))
            write_pose_report(folder, report)
            by_stem = {photo.stem: photo for photo in photos.paths}
            stems = [Path(name).stem for name in posed.cameras.names]
            # the views of panoramas are no photos of their own, with another compass direction each
            originals = tuple(by_stem[stem] for stem in stems) if set(stems) <= by_stem.keys() else ()
        require_coverage(posed, str(self.capture))
        write_capture(folder, posed.limited(self.max_side) if self.max_side > 0 else posed)
        if originals:
            context.console.say(f"{self.capture}: {find_in_coverage(posed.cameras)}")
        if self.clock_sun and originals:
            self._write_clock_sun(folder, originals, posed.cameras, context)

    def _write_clock_sun(self, folder: Path, photos: Sequence[Path], cameras: Cameras, context: Context) -> None:
        """Write the sun's direction by the photos' clock; a capture that is taken over may have it already."""
        sun = read_clock_sun(self.capture)
        if sun is None:
            tags = [read_geotag(photo) for photo in photos]
            notes = geotag_notes(tags, cameras.names)
            context.console.tell(*(replace(note, text=f"{self.capture}: {note.text}") for note in notes))
            sun = sun_by_clock(tags, cameras)
        if sun is not None:
            write_clock_sun(folder, sun)
            context.console.say(f"{self.capture}: {sun.describe(cameras)}")

    def _taken_over(self, context: Context) -> PosedImages:
        """Read the posed capture without its unusable images, which are printed."""
        given = read_capture(self.capture)
        masks = describe_masks(given.image_paths, given.mask_paths)
        context.console.say(f"{self.capture}: {len(given)} posed images, {len(given.points)} points; {masks}")
        context.console.tell(*unposed_notes(self.capture, given))
        posed = usable_views(given, keep_odd=self.keep_odd, progress=context.progress)
        context.console.tell(*left_out_notes(self.capture, len(posed), posed.left_out))
        return posed

    def _with_given_poses(self, poses: Path, folder: Path, context: Context) -> PosedImages:
        """Combine the photos with the poses of another program."""
        photos = self._photos(folder, context)
        context.console.tell(*exposure_notes(self.capture, photos.paths))
        posed, without_pose, without_photo = read_given_poses(poses, photos)
        say = context.console.say
        say(f"{poses}: poses of {len(posed)} of {len(photos.paths)} photos, {len(posed.points)} points")
        if without_pose:
            say(f"{poses}: without a pose, left out: {', '.join(without_pose)}")
        if without_photo:
            say(f"{self.capture}: without a photo, left out: {', '.join(without_photo)}")
        return posed

    def _pictures(self, folder: Path, context: Context) -> PosedImages:
        """Render pictures of a scene without photographs."""
        read = read_scene(self.capture, axes=self.axes)
        scene = read.gaussians
        found, report = place_virtual_cameras(scene, self.look, stated_up=read.metadata.up, progress=context.progress)
        for sentence in read.said():
            context.console.say(f"{self.capture}: {sentence}")
        if read.metadata.metres_per_unit is not None:
            write_scale(folder, MetricScale(read.metadata.metres_per_unit, f"stated in {self.capture.name}"))
        (folder / "images").mkdir()
        paths = tuple(folder / "images" / f"{name}.png" for name in found.cameras.names)
        for index, (path, camera) in enumerate(zip(paths, found.cameras, strict=True)):
            write_image(path, render(scene, camera).color[0].clamp(0, 1))
            context.progress(index + 1, len(paths), "pictures of the scene")
        for note in report:
            picture = paths[0] if note.in_doubt else None
            context.console.tell(replace(note, text=f"{self.capture}: {note.text}", picture=picture))
        return replace(found, image_paths=paths)

    def _photos(self, folder: Path, context: Context) -> PhotoFiles:
        if is_archive(self.capture):
            given = unpack_photos(self.capture, folder / "unpacked")
        elif self.capture.is_dir():
            given = self.capture
        else:
            frames, notes = extract_frames(self.capture, folder / "frames", progress=context.progress)
            context.console.tell(*(replace(note, text=f"{self.capture}: {note.text}") for note in notes))
            return PhotoFiles(tuple(frames))
        found = find_photos(given)
        kept, odd = usable_photos(found.paths, str(self.capture), keep_odd=self.keep_odd, progress=context.progress)
        photos, empty = usable_masks(found.only(kept))
        for left_out in (odd, empty):
            context.console.tell(*left_out_notes(self.capture, len(kept), left_out))
        masks = describe_masks(photos.paths, photos.masks)
        context.console.say(f"{self.capture}: {len(photos.paths)} photos; {masks}")
        return photos


def doubt_about(step: Capture) -> str | None:
    """Describe in one line why the poses of `step` are doubtful and what to do; None if they can be used."""
    doubts = read_doubts(step.out)
    if not doubts or step.accept_doubtful:
        return None
    return (
        f"{step.out}: expected plausible poses, found doubtful ones ({'; '.join(map(str, doubts))}); take "
        f'more photos with more overlap, or set effort = "thorough", or lens = "each" if zoom or focus '
        f"changed, or give poses (a COLMAP folder or transforms.json); to continue with these poses, which are kept, "
        f"set accept_doubtful = true for this capture or use run --accept-doubtful"
    )


COMMAND = Capture
