"""The command `capture`: photos, a video, a posed capture or a trained scene become a folder with transforms.json."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from splatgraft.capture import (
    PoseOptions,
    VirtualCameraOptions,
    extract_frames,
    place_virtual_cameras,
    pose_photos,
    read_pose_report,
    render_pictures,
    write_pose_report,
)
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.folders.capture_files import capture_inputs, has_poses
from splatgraft.folders.photo_exposures import exposure_warnings
from splatgraft.formats import is_scene, read_capture, read_gaussians, write_capture
from splatgraft.formats.captures.given_poses import pose_files, read_given_poses
from splatgraft.formats.captures.masks import PhotoFiles, describe_masks, find_photos
from splatgraft.project.step import Context, Inputs, Positional


@dataclass(frozen=True)
class Capture:
    """Pose photos or a video; poses that are there already are taken over, and images are then referred to. Of a
    trained scene without photographs, pictures are made from all around."""

    capture: Positional
    """A folder of photos, a video, a COLMAP folder, a folder with transforms.json, or a .ply, .spz or .splat."""
    out: Path = Path("capture")
    """Folder for transforms.json and points.ply."""
    poses: Path | None = None
    """Poses that another program found for photos: a COLMAP folder, a transforms.json or Metashape's cameras as XML."""
    max_side: int = 1600
    """Longest side at which images are served from here on, pixels; 0 keeps all."""
    accept_doubtful: bool = False
    """Whether `run` goes on with poses that are not plausible; without it, it stops after this step."""
    options: PoseOptions = field(default_factory=PoseOptions)
    look: VirtualCameraOptions = field(default_factory=VirtualCameraOptions)

    def inputs(self) -> Inputs:
        """The photos, or the video, or the scene, or the files of the posed capture."""
        if self.poses is None and has_poses(self.capture):
            return capture_inputs(self.capture, read_capture(self.capture), masks=True)
        if not self.capture.is_dir():
            if self.poses is not None:
                raise ValueError(f"{self.capture}: expected a folder of photos beside --poses, found none")
            return {"photos": (self.capture,)}
        photos = find_photos(self.capture)
        files = {"photos": photos.paths, "masks": tuple(mask for mask in photos.masks if mask is not None)}
        return files if self.poses is None else files | {"poses": pose_files(self.poses)}

    def write(self, folder: Path, context: Context) -> None:
        """Make the posed capture."""
        if self.poses is not None:
            posed = self._with_given_poses(self.poses, context)
        elif is_scene(self.capture):
            posed = self._pictures(folder, context)
        elif has_poses(self.capture):
            posed = read_capture(self.capture)
            masks = describe_masks(posed.image_paths, posed.mask_paths)
            context.console.say(f"{self.capture}: {len(posed)} posed images, {len(posed.points)} points; {masks}")
            self._warn_of_exposures(posed.image_paths, context)
        else:
            photos = self._photos(folder, context)
            self._warn_of_exposures(photos.paths, context)
            posed, report = pose_photos(
                photos,
                folder,
                scratch=context.checkpoint.folder / "colmap",
                options=self.options,
                progress=context.progress,
                say=lambda sentence: context.console.say(f"{self.capture}: {sentence}"),
            )
            context.console.say(f"{self.capture}: {report}")
            for doubt in report.doubts:
                context.console.warn(f"{self.capture}: doubtful: {doubt}")
            write_pose_report(folder, report)
        write_capture(folder, _limited(posed, self.max_side))

    def _with_given_poses(self, poses: Path, context: Context) -> PosedImages:
        """Photos with the poses of another program."""
        photos = self._photos(self.out, context)
        self._warn_of_exposures(photos.paths, context)
        given = read_given_poses(poses, photos)
        say = context.console.say
        say(f"{poses}: poses of {len(given.posed)} of {len(photos.paths)} photos, {len(given.posed.points)} points")
        if given.without_pose:
            say(f"{poses}: without a pose, left out: {', '.join(given.without_pose)}")
        if given.without_photo:
            say(f"{self.capture}: without a photo, left out: {', '.join(given.without_photo)}")
        return given.posed

    def _pictures(self, folder: Path, context: Context) -> PosedImages:
        """Pictures of a scene that came without photographs."""
        scene = read_gaussians(self.capture)
        found = place_virtual_cameras(scene, self.look, progress=context.progress)
        for sentence in found.report:
            context.console.say(f"{self.capture}: {sentence}")
        (folder / "images").mkdir()
        paths = {name: folder / "images" / f"{name}.png" for name in found.cameras.names}
        render_pictures(
            scene, found, write=lambda name, picture: write_image(paths[name], picture), progress=context.progress
        )
        return PosedImages(
            image_paths=tuple(paths.values()),
            cameras=found.cameras,
            points=found.points,
            point_colors=found.point_colors,
        )

    def _warn_of_exposures(self, photos: Sequence[Path], context: Context) -> None:
        for warning in exposure_warnings(self.capture, photos):
            context.console.warn(warning)

    def _photos(self, folder: Path, context: Context) -> PhotoFiles:
        if not self.capture.is_dir():
            return PhotoFiles(tuple(extract_frames(self.capture, folder / "frames", progress=context.progress)))
        photos = find_photos(self.capture)
        masks = describe_masks(photos.paths, photos.masks)
        context.console.say(f"{self.capture}: {len(photos.paths)} photos; {masks}")
        return photos


def doubt_about(step: Capture) -> str | None:
    """Why the result of `step` should not be built upon and what to do, in one line; None where it may be.

    Raises:
        ValueError: Where its pose_report.json is damaged.
    """
    report = read_pose_report(step.out)
    if report is None or not report.doubts or step.accept_doubtful:
        return None
    return (
        f"{step.out}: expected plausible poses, found doubtful ones ({'; '.join(str(d) for d in report.doubts)}); take "
        f'more photos with more overlap, or set effort = "thorough", or lens = "each" where zoom or focus '
        f"changed, or give poses (a COLMAP folder or transforms.json); to go on with these poses, which are kept, set "
        f"accept_doubtful = true for this capture or use run --accept-doubtful"
    )


def _limited(posed: PosedImages, max_side: int) -> PosedImages:
    longest = int(posed.cameras.sizes.max()) if len(posed) else 0
    return posed.resized(max_side / longest) if 0 < max_side < longest else posed


COMMAND = Capture
