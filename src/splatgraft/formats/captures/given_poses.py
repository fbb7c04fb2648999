"""Photos and the poses that another program found for them, which lie somewhere else: joined by the photos' names."""

from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath

from splatgraft.core.posed_images import PosedImages
from splatgraft.formats.captures import find_poses, read_capture_file
from splatgraft.formats.captures.masks import PhotoFiles
from splatgraft.formats.captures.views import fitted_to_file, posed_images

_MIN_PHOTOS = 3
"""Photos with a pose: below it nothing is seen from two sides and checked by a third."""


@dataclass(frozen=True)
class GivenPoses:
    """Photos with the poses given for them."""

    posed: PosedImages
    """Photos that have a pose, in the order of the poses."""
    without_pose: tuple[str, ...]
    """Names of the other photos."""
    without_photo: tuple[str, ...]
    """Names of the poses whose photo is not there."""


def read_given_poses(source: Path, photos: PhotoFiles) -> GivenPoses:
    """The `photos` with the poses in `source`; a pose belongs to the photo with its name, whatever its suffix.

    Args:
        source: A folder with a COLMAP model or a transforms.json, or a file of these.
        photos: With their masks.
    """
    found = find_poses(source) or find_poses(source.parent if source.is_file() else source)
    if found is None:
        raise ValueError(f"{source}: expected poses (a COLMAP model or transforms.json), found neither")
    file = read_capture_file(found)
    views = file.records()
    masks = photos.masks or (None,) * len(photos.paths)
    by_stem = {path.stem: (path, mask) for path, mask in zip(photos.paths, masks, strict=True)}
    known = {path.name: path.stem for path in photos.paths}
    stems = [_stem(view.name, known) for view in views]
    twice = sorted({stem for stem in stems if stem in by_stem and stems.count(stem) > 1})
    if twice:
        raise ValueError(f"{source}: expected one pose for the photo {twice[0]}, found {stems.count(twice[0])}")
    fitted = [
        fitted_to_file(replace(view, image_path=by_stem[stem][0], mask_path=by_stem[stem][1]), source)
        for view, stem in zip(views, stems, strict=True)
        if stem in by_stem
    ]
    if len(fitted) < _MIN_PHOTOS:
        raise ValueError(
            f"{source}: expected poses of {_MIN_PHOTOS} photos of {photos.paths[0].parent}, found {len(fitted)}: "
            f"its first is named {views[0].name}, the first photo {photos.paths[0].name}"
        )
    return GivenPoses(
        posed=posed_images(replace(file, folder=photos.paths[0].parent, views=fitted)),
        without_pose=tuple(path.name for path in photos.paths if path.stem not in stems),
        without_photo=tuple(view.name for view, stem in zip(views, stems, strict=True) if stem not in by_stem),
    )


def _stem(name: str, known: dict[str, str]) -> str:
    """The stem of the photo; Blender's paths may lack the suffix."""
    last = PureWindowsPath(name).name
    return known.get(last) or (last if last in known.values() else PureWindowsPath(last).stem)
