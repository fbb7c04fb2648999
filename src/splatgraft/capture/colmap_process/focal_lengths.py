"""Focal lengths to start from: of EXIF, of the view graph's calibration, or the median of cameras of their own."""

from pathlib import Path

import numpy as np

from .features import copy_database, fresh
from .job import SEARCH

Focals = dict[int, float]
"""Focal length in pixels by the number of the camera in a database."""


def calibrated_focals(database: Path, seed: int) -> Focals:
    """Focal length by camera: from EXIF where COLMAP read one, else from the fundamental matrices of all pairs.

    On a copy, since COLMAP also estimates the pairs anew, and with its 1 px that leaves fewer matches.
    """
    import pycolmap

    copy = copy_database(database, database.with_suffix(".calibrated.db"))
    with pycolmap.Database.open(database) as original:
        cameras = {camera.camera_id: camera for camera in original.read_all_cameras()}
        images = original.read_all_images()
    pycolmap.calibrate_view_graph(copy, pycolmap.ViewGraphCalibrationOptions(random_seed=seed))
    with pycolmap.Database.open(copy) as calibrated:
        found = {camera.camera_id: float(camera.params[0]) for camera in calibrated.read_all_cameras()}
    count = {i: sum(image.camera_id == i for image in images) for i in cameras}
    common = max(cameras, key=lambda i: count[i])
    focals: Focals = {}
    for i in sorted(cameras, key=lambda i: -count[i]):
        size, low, high = max(cameras[i].width, cameras[i].height), *SEARCH.focal_range
        believed = low * size < found[i] < high * size
        if cameras[i].has_prior_focal_length or not believed:
            focals[i] = float(cameras[i].params[0])
        elif count[i] < SEARCH.min_track < count[common]:
            # a photo or two say little of a focal length; most likely the others' lens, at another size
            focals[i] = focals[common] * size / max(cameras[common].width, cameras[common].height)
        else:
            focals[i] = found[i]
    return focals


def with_focals(database: Path, target: Path, focals: Focals) -> Path:
    """A copy of `database` at `target` whose cameras start from `focals`."""
    import pycolmap

    copy_database(database, fresh(target))
    with pycolmap.Database.open(target) as opened:
        for camera in opened.read_all_cameras():
            if camera.camera_id in focals:
                camera.params = [focals[camera.camera_id], *camera.params[1:]]
                opened.update_camera(camera)
    return target


def with_own_cameras(database: Path, target: Path) -> Path:
    """A copy of `database` at `target` in which each photo has a camera of its own, with the number of the photo."""
    import pycolmap

    with pycolmap.Database.open(database) as shared, pycolmap.Database.open(fresh(target)) as own:
        for image in shared.read_all_images():
            camera = shared.read_camera(image.camera_id)
            camera.camera_id = image.camera_id = image.frame_id = image.image_id
            rig, frame = pycolmap.Rig(rig_id=image.image_id), pycolmap.Frame(frame_id=image.image_id)
            rig.add_ref_sensor(camera.sensor_id)
            frame.rig_id = rig.rig_id
            frame.add_data_id(image.data_id)
            own.write_camera(camera, use_camera_id=True)
            own.write_rig(rig, use_rig_id=True)
            own.write_frame(frame, use_frame_id=True)
            own.write_image(image, use_image_id=True)
            own.write_keypoints(image.image_id, shared.read_keypoints(image.image_id))
        for pair, geometry in zip(*shared.read_two_view_geometries(), strict=True):
            own.write_two_view_geometry(*pycolmap.pair_id_to_image_pair(pair), geometry)
    return target


def median_focals(database: Path, models: list) -> Focals:
    """Per shared camera of `database`, the median focal length of its photos in the largest of `models`."""
    import pycolmap

    if not models:
        return {}
    with pycolmap.Database.open(database) as shared:
        camera_of = {image.image_id: image.camera_id for image in shared.read_all_images()}
    model = max(models, key=lambda m: m.num_reg_images())
    found: dict[int, list[float]] = {}
    for image in model.images.values():
        if image.has_pose:
            found.setdefault(camera_of[image.image_id], []).append(float(model.cameras[image.camera_id].params[0]))
    return {camera: float(np.median(focals)) for camera, focals in found.items()}
