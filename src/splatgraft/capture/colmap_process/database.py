"""COLMAP databases: features of all photos, verified matches between them, and initial focal lengths.

Each database is written under another name and then moved to its place, so a killed run leaves only complete ones.
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
_FEATURES = 4000  # largest features kept per photo; matching time grows with its square (COLMAP: 8192)
_LARGE_PX = 1200  # longest side from which SIFT skips the octave of doubled size, two thirds of its time
_PRESELECT_ABOVE = 24  # largest number of photos for which all pairs are matched with all features at once
_PRESELECT_FEATURES = 1000  # largest features of a photo in preemptive matching (Wu 2013, section 3)
_PRESELECT_PARTNERS = 8  # photos with fewer partners than this are matched with all others
_MOST_PARTNERS = 16  # most partners of a photo; a static background matches in all photos
_FOCAL_RANGE = (0.35, 5.0)  # plausible calibrated focal lengths, over the longest side of the photo

Selection = Callable[[int, np.ndarray], np.ndarray]
"""Choice of features: takes the id of a photo and its features (n, 2 or more: x, y, shape), returns indices to keep."""


def find_features(job: Job) -> None:
    """Make the database of `job` with one camera per group and the features of all photos.

    Focal lengths start from EXIF if it has one. Features that a killed run left are kept.
    """
    database = job.folder / "photos.db"
    alone = [names[0] for names in job.groups if len(names) == 1]
    groups = [(pycolmap.CameraMode.SINGLE, names) for names in job.groups if len(names) > 1]
    groups += [(pycolmap.CameraMode.PER_IMAGE, alone)] if alone else []
    photos = Path(job.photos)
    reader = pycolmap.ImageReaderOptions(camera_model=job.camera_model, camera_mask_path=job.common_mask)
    if not database.exists():
        partial = fresh(job.folder / "partial.db")
        pycolmap.Database.open(partial).close()
        for mode, names in groups:
            # first, because the threads that find features would number photos in the order in which they finish
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
    """Remove the database at `path` that a killed run may have left, and return `path`."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    return path


def copy_database(source: Path, target: Path) -> Path:
    """Copy the database `source` to `target`, completely or not at all."""
    partial = fresh(target.with_suffix(".partial"))
    # SQLite's own copy, because a part of a database may lie in files beside it
    with closing(sqlite3.connect(source)) as original, closing(sqlite3.connect(partial)) as copy:
        original.backup(copy)
    os.replace(partial, target)
    return target


def copy_with_features(source: Path, target: Path, select: Selection) -> None:
    """Copy `source` to `target` with only the selected features and no matches, unless `target` exists."""
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
    """Make a selection of the features at which the photo's mask is not black, or of all if it has no mask."""
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
    """Select the largest features."""
    # columns 2 to 5 hold the affine shape by rows; the length of its first column is the feature's size
    return np.argsort(-np.hypot(keypoints[:, 2], keypoints[:, 4]), kind="stable")[:_PRESELECT_FEATURES]


def _names(database: Path) -> dict[int, str]:
    with pycolmap.Database.open(database) as opened:
        return {image.image_id: image.name for image in opened.read_all_images()}


def levels(job: Job) -> list[str]:
    """Return the choices of pairs, the cheapest first; each contains the ones before it."""
    choices = [PROMISING, ALL] if len(job.names) > _PRESELECT_ABOVE else [ALL]
    return choices if job.exhaustive else [NEIGHBOURING, *choices]


def match(job: Job, database: Path, level: str) -> int:
    """Match the pairs of `level` that are not matched yet, and return their number."""
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
    """Count the pairs that were not matched yet."""
    photos = len(job.names)
    return photos * (photos - 1) // 2 - _matched(database)


def _matched(database: Path) -> int:
    """Count the pairs that were matched, including pairs without a match."""
    with closing(sqlite3.connect(database)) as opened:
        return int(opened.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0])


def _promising_pairs(job: Job, database: Path) -> Path:
    """Write a file of the pairs whose largest features match best; photos with few such pairs get all pairs."""
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
    partial.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in sorted(pairs)), encoding="utf-8")
    os.replace(partial, listed)
    return listed


def copy_with_cameras(source: Path, target: Path, change: Callable[[Any], None]) -> Path:
    """Copy the database `source` to `target` and apply `change` to each of its cameras."""
    copy_database(source, fresh(target))
    with pycolmap.Database.open(target) as opened:
        for camera in opened.read_all_cameras():
            change(camera)
            opened.update_camera(camera)
    return target


def with_calibrated_focals(database: Path, target: Path, seed: int) -> Path:
    """Copy `database` to `target` with a focal length per camera: from EXIF, else from view graph calibration.

    The calibration runs on another copy, because COLMAP then verifies all pairs again with a limit of 1 px, which
    leaves fewer matches.
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
            # one or two photos do not determine a focal length: assume the others' lens at another size
            focals[i] = focals[common] * size / max(cameras[common].width, cameras[common].height)
        else:
            focals[i] = found[i]

    def start(camera: Any) -> None:
        camera.params = [focals[camera.camera_id], *camera.params[1:]]

    return copy_with_cameras(database, target, start)
