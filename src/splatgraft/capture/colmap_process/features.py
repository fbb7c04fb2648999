"""Features of all photos in a COLMAP database, and databases with a part of them."""

import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np

from .job import Job

Selection = Callable[[int, np.ndarray], np.ndarray]
"""From the number of a photo and its features (n, 2 or more: x, y, shape) to the indices of those that stay."""


def find_features(job: Job) -> Path:
    """The database of `job` with a camera per group and the features of all photos; goes on where a killed run was.

    The focal length of a camera starts from EXIF where there is one.
    """
    import pycolmap

    database = job.folder / "photos.db"
    alone = [names[0] for names in job.groups if len(names) == 1]
    groups = [(pycolmap.CameraMode.SINGLE, names) for names in job.groups if len(names) > 1]
    groups += [(pycolmap.CameraMode.PER_IMAGE, alone)] if alone else []
    photos, reader = Path(job.photos), pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    if not database.exists():
        partial = fresh(job.folder / "partial.db")
        pycolmap.Database.open(partial).close()
        for mode, names in groups:
            # before the features, whose threads would number the photos as they finish
            pycolmap.import_images(partial, photos, mode, image_names=names, options=reader)
        os.replace(partial, database)
    for mode, names in groups:
        pycolmap.extract_features(
            database,
            photos,
            image_names=names,
            camera_mode=mode,
            reader_options=reader,
            extraction_options=_extraction(job),
            device=pycolmap.Device.cpu,
        )
    return database


def copy_database(source: Path, target: Path) -> Path:
    """`target` as a whole copy of `source`, or not at all."""
    partial = fresh(target.with_suffix(".partial"))
    # SQLite may hold a part of its content in files beside it
    with closing(sqlite3.connect(source)) as original, closing(sqlite3.connect(partial)) as copy:
        original.backup(copy)
    os.replace(partial, target)
    return target


def copy_with_features(source: Path, target: Path, select: Selection) -> Path:
    """A copy of `source` without matches and with the selected features alone."""
    import pycolmap

    partial = copy_database(source, target.with_suffix(".selected"))
    with pycolmap.Database.open(partial) as few:
        features = {
            image.image_id: (few.read_keypoints(image.image_id), few.read_descriptors(image.image_id))
            for image in few.read_all_images()
        }
        few.clear_two_view_geometries()
        few.clear_matches()
        few.clear_keypoints()
        few.clear_descriptors()
        for i, (keypoints, descriptors) in features.items():
            kept = select(i, keypoints)
            descriptors.data = np.ascontiguousarray(descriptors.data[kept])
            few.write_keypoints(i, np.ascontiguousarray(keypoints[kept]))
            few.write_descriptors(i, descriptors)
    os.replace(partial, target)
    return target


def inside_masks(job: Job, database: Path) -> Selection:
    """Selects the features on which the photo's mask is not black; all features of a photo without a mask."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}

    def select(i: int, keypoints: np.ndarray) -> np.ndarray:
        path = Path(job.masks) / f"{names[i]}.png"
        if not path.is_file():
            return np.arange(len(keypoints))
        bitmap = pycolmap.Bitmap.read(str(path), as_rgb=False)
        assert bitmap is not None, path
        mask = bitmap.to_array()
        height, width = mask.shape[:2]
        x = keypoints[:, 0].astype(int).clip(0, width - 1)
        y = keypoints[:, 1].astype(int).clip(0, height - 1)
        return np.flatnonzero(mask[y, x] > 0)

    return select


def largest(count: int) -> Selection:
    """Selects the `count` largest features."""

    def select(i: int, keypoints: np.ndarray) -> np.ndarray:
        # x, y, then the rows of the affine shape; its first column is as long as the feature is large
        return np.argsort(-np.hypot(keypoints[:, 2], keypoints[:, 4]), kind="stable")[:count]

    return select


def fresh(path: Path) -> Path:
    """`path`, with what a killed run left there removed."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    return path


def _extraction(job: Job):
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions(num_threads=job.threads, use_gpu=False)
    if job.thorough:
        extraction.sift.estimate_affine_shape = True
        extraction.sift.domain_size_pooling = True
        extraction.sift.peak_threshold = 0.003
        extraction.sift.max_num_features = 12000
    return extraction
