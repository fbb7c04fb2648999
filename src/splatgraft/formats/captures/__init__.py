"""Captures: finding and reading their poses, and joining the poses to photos in another folder."""

from dataclasses import replace
from pathlib import Path, PureWindowsPath

from splatgraft.core.posed_images import PosedImages
from splatgraft.formats.captures.colmap import is_colmap, read_colmap
from splatgraft.formats.captures.masks import PhotoFiles
from splatgraft.formats.captures.transforms_json import read_json
from splatgraft.formats.captures.views import CaptureFile, fitted_to_file, posed_images

_MIN_PHOTOS = 3  # with a pose: two triangulate a point, and a third checks it


def find_poses(path: Path) -> Path | None:
    """Find the JSON file with the poses of a capture, or its COLMAP folder; `path` may be that file."""
    if path.suffix.lower() == ".json":
        return path
    for name in ("transforms.json", "transforms_train.json"):
        if (path / name).is_file():
            return path / name
    return path if is_colmap(path) else None


def read_capture_file(path: Path) -> CaptureFile:
    """Read a capture from a folder or its JSON file; transforms.json is preferred to COLMAP's files."""
    if not path.exists():
        raise ValueError(f"{path}: expected a capture folder or a transforms.json, found nothing there")
    found = path if path.is_file() else find_poses(path)
    if found is None:
        raise ValueError(
            f"{path}: expected transforms.json, or a COLMAP model in sparse/0, "
            f"found {sorted(entry.name for entry in path.iterdir())[:6]}"
        )
    return read_json(found) if found.is_file() else read_colmap(found)


def read_given_poses(source: Path, photos: PhotoFiles) -> tuple[PosedImages, list[str], list[str]]:
    """Join photos with given poses; returns the names of photos without a pose and of poses without a photo as well.

    A pose belongs to the photo with its name; suffixes may differ.

    Args:
        source: A folder with a COLMAP model or a transforms.json, or one of their files.
        photos: Photos and their masks.
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
    posed = posed_images(replace(file, folder=photos.paths[0].parent, views=fitted))
    without_pose = [path.name for path in photos.paths if path.stem not in stems]
    return posed, without_pose, [view.name for view, stem in zip(views, stems, strict=True) if stem not in by_stem]


def _stem(name: str, known: dict[str, str]) -> str:
    """Return the stem of the photo that a pose names; Blender's paths may lack the suffix."""
    last = PureWindowsPath(name).name
    return known.get(last) or (last if last in known.values() else PureWindowsPath(last).stem)
