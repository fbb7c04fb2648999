"""Exposure metadata of a capture's photographs, read from the image files that it names."""

from collections.abc import Sequence
from pathlib import Path

from splatgraft.core.exposure import LuminanceScale, describe_inconsistency, luminance_scale
from splatgraft.core.images import mean_luminance
from splatgraft.formats import list_capture_images
from splatgraft.formats.captures.exif import read_exposure


def exposure_warnings(name: Path, photos: Sequence[Path]) -> list[str]:
    """At most one line that starts with `name`, where the photos' exposures differ or white balance was automatic.

    Raises: ValueError where a photo is no readable image.
    """
    found = describe_inconsistency([read_exposure(photo) for photo in photos])
    return [] if found is None else [f"{name}: {found}"]


def read_luminance_scale(cameras: Path) -> LuminanceScale | None:
    """The luminance behind the values of a capture; None where its images do not exist or have no exposure data.

    Args:
        cameras: The capture's folder or transforms.json.

    Raises:
        ValueError: An image exists and is not readable, or there is no capture.
    """
    photos = list_capture_images(cameras)
    exposures = [read_exposure(photo) for photo in photos]
    if all(one.ev100 is None for one in exposures):
        return None  # no pixels need be read
    return luminance_scale(exposures, [mean_luminance(photo) for photo in photos])
