"""Photos and the poses that another program found for them, which lie somewhere else: joined by the photos' names."""

from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath

from jaxtyping import Float
from torch import Tensor

from splatgraft.core.posed_images import PosedImages
from splatgraft.formats.captures import colmap, transforms_json
from splatgraft.formats.captures.masks import PhotoFiles
from splatgraft.formats.captures.views import ViewRecord, fitted_to_file, posed_images_of

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


def pose_files(source: Path) -> tuple[Path, ...]:
    """The files that `read_given_poses` reads.

    Raises: ValueError where there is nothing at `source`.
    """
    if source.is_file():
        return (source,)
    if not source.is_dir():
        raise ValueError(f"{source}: expected a file or folder with poses, found nothing")
    suffixes = {".json", ".ply", ".bin", ".txt"}
    return tuple(sorted(p for p in source.rglob("*") if p.is_file() and p.suffix in suffixes and p.name != "step.json"))


def read_given_poses(source: Path, photos: PhotoFiles) -> GivenPoses:
    """The `photos` with the poses in `source`; a pose belongs to the photo with its name, whatever its suffix.

    Args:
        source: A folder with a COLMAP model or a transforms.json, or that file itself.
        photos: With their masks.

    Raises:
        ValueError: There is no such thing at `source`, it is broken, or fewer than three photos have a pose.
    """
    views, points, colors = _read(source)
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
        posed=posed_images_of(fitted, source, folder=photos.paths[0].parent, points=points, colors=colors),
        without_pose=tuple(path.name for path in photos.paths if path.stem not in stems),
        without_photo=tuple(view.name for view, stem in zip(views, stems, strict=True) if stem not in by_stem),
    )


def _read(source: Path) -> tuple[list[ViewRecord], Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    transforms = next((f for f in (source, source / "transforms.json") if f.suffix == ".json" and f.is_file()), None)
    if transforms is not None:
        return transforms_json.read_views(transforms)
    folder = source.parent if source.is_file() else source
    if not colmap.is_colmap(folder):
        raise ValueError(f"{source}: expected poses (a COLMAP model or transforms.json), found neither")
    return colmap.read_views(folder)


def _stem(name: str, known: dict[str, str]) -> str:
    """The stem of the photo; Blender's paths may lack the suffix."""
    last = PureWindowsPath(name).name
    return known.get(last) or (last if last in known.values() else PureWindowsPath(last).stem)
