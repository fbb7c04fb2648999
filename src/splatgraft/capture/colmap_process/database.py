"""COLMAP's databases: features of all photos, verified matches between them, and the focal lengths to start from.

A killed run leaves whole databases to the next: each is written beside its place and then moved there.
"""

import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from .job import MIN_TRACK, Job

NEIGHBOURING, PROMISING, ALL = "neighbouring", "promising", "all"
_FEATURES = 4000  # of a photo, the largest; the time of matching goes with its square. COLMAP takes 8192.
_LARGE_PX = 1200
"""Longest side from which photos are not doubled in size to find features, which takes two thirds of the time."""
_PRESELECT_ABOVE = 24  # photos; up to this many, all pairs are compared with all features
_PRESELECT_FEATURES = 1000
"""Largest features of a photo by which its partners are found (preemptive matching: Wu 2013, section 3)."""
_PRESELECT_PARTNERS = 8  # A photo with fewer partners than this is compared with all others
_MOST_PARTNERS = 16
"""Partners of a photo, those with most matches first: a background that stands still matches in all photos."""
_FOCAL_RANGE = (0.35, 5.0)
"""Focal lengths, in longest sides of the photo, that are believed of the view graph's calibration."""

Selection = Callable[[int, np.ndarray], np.ndarray]
"""From the number of a photo and its features (n, 2 or more: x, y, shape) to the indices of those that stay."""


def find_features(job: Job) -> None:
    """Make the database of `job` with a camera per group and the features of all photos; go on where a killed run was.

    The focal length of a camera starts from EXIF where there is one.
    """
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
    extraction = pycolmap.FeatureExtractionOptions(num_threads=job.threads, use_gpu=False)
    extraction.sift.max_num_features = _FEATURES
    with pycolmap.Database.open(database) as opened:
        longest = np.median([max(camera.width, camera.height) for camera in opened.read_all_cameras()])
    if longest >= _LARGE_PX:
        extraction.sift.first_octave = 0
    if job.thorough:
        extraction.sift.estimate_affine_shape = True
        extraction.sift.domain_size_pooling = True
        extraction.sift.peak_threshold = 0.003
        extraction.sift.first_octave = -1
        extraction.sift.max_num_features = 12000
    for mode, names in groups:
        pycolmap.extract_features(
            database,
            photos,
            image_names=names,
            camera_mode=mode,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )


def fresh(path: Path) -> Path:
    """`path`, with what a killed run left there removed."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    return path


def copy_database(source: Path, target: Path) -> Path:
    """`target` as a whole copy of `source`, or not at all."""
    partial = fresh(target.with_suffix(".partial"))
    # SQLite may hold a part of its content in files beside it
    with closing(sqlite3.connect(source)) as original, closing(sqlite3.connect(partial)) as copy:
        original.backup(copy)
    os.replace(partial, target)
    return target


def copy_with_features(source: Path, target: Path, select: Selection) -> None:
    """Make a copy of `source` without matches and with the selected features alone, where there is none yet."""
    if target.exists():
        return
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


def inside_masks(job: Job, database: Path) -> Selection:
    """Selects the features on which the photo's mask is not black; all features of a photo without a mask."""
    names = _names(database)

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


def _largest(_: int, keypoints: np.ndarray) -> np.ndarray:
    """Selects the largest features."""
    # x, y, then the rows of the affine shape; its first column is as long as the feature is large
    return np.argsort(-np.hypot(keypoints[:, 2], keypoints[:, 4]), kind="stable")[:_PRESELECT_FEATURES]


def _names(database: Path) -> dict[int, str]:
    with pycolmap.Database.open(database) as opened:
        return {image.image_id: image.name for image in opened.read_all_images()}


def levels(job: Job) -> list[str]:
    """Choices of pairs, the cheapest first; each holds the earlier ones."""
    choices = [PROMISING, ALL] if len(job.names) > _PRESELECT_ABOVE else [ALL]
    return choices if job.exhaustive else [NEIGHBOURING, *choices]


def match(job: Job, database: Path, level: str) -> int:
    """Match the pairs of `level` that are not matched already; gives their number."""
    before = _matched(database)
    matching = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False)
    if job.thorough:
        matching.sift.max_ratio = 0.85
        matching.guided_matching = True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.seed
    shared: dict[str, Any] = {"verification_options": verification, "device": pycolmap.Device.cpu}
    if level == NEIGHBOURING:
        pycolmap.match_sequential(database, matching, **shared)
    elif level == ALL:
        pycolmap.match_exhaustive(database, matching, **shared)
    else:
        pairs = pycolmap.ImportedPairingOptions(match_list_path=str(_promising_pairs(job, database)))
        pycolmap.match_image_pairs(database, matching, pairs, **shared)
    return _matched(database) - before


def unmatched_pairs(job: Job, database: Path) -> int:
    """Pairs that were not compared yet."""
    photos = len(job.names)
    return photos * (photos - 1) // 2 - _matched(database)


def _matched(database: Path) -> int:
    """Pairs that were compared, with or without a match."""
    with closing(sqlite3.connect(database)) as opened:
        return int(opened.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0])


def _promising_pairs(job: Job, database: Path) -> Path:
    """The file of pairs whose largest features match best; a photo with few of these is paired with every other."""
    listed, small = database.with_suffix(".pairs.txt"), database.with_suffix(".small.db")
    if listed.exists():
        return listed
    copy_with_features(database, small, _largest)
    options = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False, skip_geometric_verification=True)
    pycolmap.match_exhaustive(small, options, device=pycolmap.Device.cpu)
    names = _names(small)
    with pycolmap.Database.open(small) as few:
        numbers, matches = few.read_all_matches()
    found = [(pycolmap.pair_id_to_image_pair(n), len(same)) for n, same in zip(numbers, matches, strict=True)]
    pairs: set[tuple[int, int]] = set()
    for i in names:
        own = sorted((entry for entry in found if i in entry[0]), key=lambda entry: -entry[1])
        pairs |= {pair for pair, _ in own[:_MOST_PARTNERS]}
        if len(own) < _PRESELECT_PARTNERS:
            pairs |= {(min(i, other), max(i, other)) for other in names if other != i}
    partial = fresh(listed.with_suffix(".partial"))
    partial.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in sorted(pairs)))
    os.replace(partial, listed)
    return listed


def copy_with_cameras(source: Path, target: Path, change: Callable[[Any], None]) -> Path:
    """A copy of the database `source` at `target`, each camera as `change` leaves it."""
    copy_database(source, fresh(target))
    with pycolmap.Database.open(target) as opened:
        for camera in opened.read_all_cameras():
            change(camera)
            opened.update_camera(camera)
    return target


def with_calibrated_focals(database: Path, target: Path, seed: int) -> Path:
    """A copy at `target` with a focal length by camera: from EXIF where COLMAP read one, else from all pairs' geometry.

    They are found on another copy, since COLMAP also estimates the pairs anew, and with its 1 px that leaves fewer
    matches.
    """
    copy = copy_database(database, database.with_suffix(".calibrated.db"))
    with pycolmap.Database.open(database) as original:
        cameras = {camera.camera_id: camera for camera in original.read_all_cameras()}
        images = original.read_all_images()
    pycolmap.calibrate_view_graph(copy, pycolmap.ViewGraphCalibrationOptions(random_seed=seed))
    with pycolmap.Database.open(copy) as calibrated:
        found = {camera.camera_id: float(camera.params[0]) for camera in calibrated.read_all_cameras()}
    count = {i: sum(image.camera_id == i for image in images) for i in cameras}
    common = max(cameras, key=lambda i: count[i])
    focals: dict[int, float] = {}
    for i in sorted(cameras, key=lambda i: -count[i]):
        size, low, high = max(cameras[i].width, cameras[i].height), *_FOCAL_RANGE
        believed = low * size < found[i] < high * size
        if cameras[i].has_prior_focal_length or not believed:
            focals[i] = float(cameras[i].params[0])
        elif count[i] < MIN_TRACK < count[common]:
            # a photo or two say little of a focal length; most likely the others' lens, at another size
            focals[i] = focals[common] * size / max(cameras[common].width, cameras[common].height)
        else:
            focals[i] = found[i]

    def start(camera: Any) -> None:
        camera.params = [focals[camera.camera_id], *camera.params[1:]]

    return copy_with_cameras(database, target, start)
