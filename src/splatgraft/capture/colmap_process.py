"""The program that runs pycolmap (its only importer) in a process of its own: features, matches, poses and points.

A process of its own, since pycolmap's bundled zlib corrupts the heap of one that also loads Pillow, and since its C++
checks end the process. Takes a job as JSON; writes the best model as JSON; reports progress on stdout.

The global mapper (GLOMAP: Pan et al. 2024, Global Structure-from-Motion Revisited) comes first. The incremental mapper
starts from one pair of photos, and where the matches of that pair lie on a plane its pose can be wrong while its error
is small: on 72 photos of a bonsai on a table the first pair was turned by 24 degrees instead of 36, with its baseline
33 degrees off, at 0.29 px. A focal length and a distortion that all photos share then bend until the rest fits, and
nothing undoes it, not even the right focal length held fixed. Averaging the rotations of all pairs has no first pair.
"""

import json
import shutil
import sys
import time
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Search:
    """What pairs are compared, and when the search for a model ends."""

    preselect_above: int = 24
    """Photos; up to this many, all pairs are compared with all features."""
    preselect_features: int = 1000
    """Largest features of a photo by which its partners are found (preemptive matching: Wu 2013, section 3)."""
    preselect_partners: int = 8
    """A photo with fewer partners than this is compared with all others."""
    min_track: int = 3
    """Photos that must see a point for it to count; two photos make a point of any false match."""
    max_error_px: float = 1.5
    """Largest mean reprojection error of a point that counts."""
    min_observations: int = 30
    """Points that a photo must see for its pose to count (COLMAP: abs_pose_min_num_inliers)."""
    clear_explained: float = 0.5
    """A model with all photos and this share of all verified matches explained ends the search."""
    focal_range: tuple[float, float] = (0.35, 5.0)
    """Focal lengths, in longest sides of the photo, that are believed of the view graph's calibration."""
    same_focal: float = 0.03
    """A second start that is closer to the first than this share gives the same model."""


SEARCH = Search()


def main(job: dict[str, Any]) -> None:
    """Features, matches, mapping; the best model goes to job["output"]."""
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)  # pyright: ignore[reportAttributeAccessIssue]
    pycolmap.set_random_seed(job["seed"])
    database = Path(job["database"])
    clock = [time.process_time()]
    say(0, "finding features")
    _find_features(job, database)
    clock.append(time.process_time())
    say(1, "matching")
    _match(job, database)
    clock.append(time.process_time())
    say(2, "mapping")
    answers: list[dict[str, Any]] = []
    for answer in _candidates(job, database):
        answers.append(answer)
        complete = len(answer["images"]) == sum(len(names) for names in job["groups"])
        if complete and answer["explained"] >= SEARCH.clear_explained:
            break
    clock.append(time.process_time())
    best = max(answers, key=lambda answer: answer["score"])
    spent = zip(("features", "matching", "mapping"), np.diff(clock).tolist(), strict=True)
    Path(job["output"]).write_text(json.dumps(best | {"cpu_seconds": dict(spent)}))


def say(done: int, what: str) -> None:
    """Tell the parent how many of three phases are done."""
    print(f"{done} {what}", flush=True)


def _find_features(job: dict[str, Any], database: Path) -> None:
    """One camera per group of job["groups"]; its focal length starts from EXIF where there is one."""
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions(num_threads=job["threads"], use_gpu=False)
    if job["thorough"]:
        extraction.sift.estimate_affine_shape = True
        extraction.sift.domain_size_pooling = True
        extraction.sift.peak_threshold = 0.003
        extraction.sift.max_num_features = 12000
    alone = [names[0] for names in job["groups"] if len(names) == 1]
    groups = [(pycolmap.CameraMode.SINGLE, names) for names in job["groups"] if len(names) > 1]
    groups += [(pycolmap.CameraMode.PER_IMAGE, alone)] if alone else []
    photos, reader = Path(job["photos"]), pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    pycolmap.Database.open(database).close()
    for mode, names in groups:
        # before the features, whose threads would number the photos as they finish
        pycolmap.import_images(database, photos, mode, image_names=names, options=reader)
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


def _match(job: dict[str, Any], database: Path) -> None:
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions(num_threads=job["threads"], use_gpu=False)
    if job["thorough"]:
        matching.sift.max_ratio = 0.85
        matching.guided_matching = True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job["seed"]
    if not job["exhaustive"]:
        pycolmap.match_sequential(database, matching, verification_options=verification, device=pycolmap.Device.cpu)
    elif sum(len(names) for names in job["groups"]) <= SEARCH.preselect_above:
        pycolmap.match_exhaustive(database, matching, verification_options=verification, device=pycolmap.Device.cpu)
    else:
        pairs = database.with_suffix(".pairs.txt")
        pairs.write_text("".join(f"{a} {b}\n" for a, b in _promising_pairs(job, database)))
        pairing = pycolmap.ImportedPairingOptions(match_list_path=str(pairs))
        pycolmap.match_image_pairs(
            database, matching, pairing, verification_options=verification, device=pycolmap.Device.cpu
        )


def _promising_pairs(job: dict[str, Any], database: Path) -> list[tuple[str, str]]:
    """Pairs whose largest features match; a photo with few of these is paired with every other."""
    import pycolmap

    small = database.with_suffix(".small.db")
    shutil.copy(database, small)
    with pycolmap.Database.open(small) as few:
        names = {image.image_id: image.name for image in few.read_all_images()}
        features = {i: (few.read_keypoints(i), few.read_descriptors(i)) for i in names}
        few.clear_keypoints()
        few.clear_descriptors()
        for i, (keypoints, descriptors) in features.items():
            # x, y, then the rows of the affine shape; its first column is as long as the feature is large
            largest = np.argsort(-np.hypot(keypoints[:, 2], keypoints[:, 4]), kind="stable")
            kept = largest[: SEARCH.preselect_features]
            descriptors.data = np.ascontiguousarray(descriptors.data[kept])
            few.write_keypoints(i, np.ascontiguousarray(keypoints[kept]))
            few.write_descriptors(i, descriptors)
    options = pycolmap.FeatureMatchingOptions(
        num_threads=job["threads"], use_gpu=False, skip_geometric_verification=True
    )
    pycolmap.match_exhaustive(small, options, device=pycolmap.Device.cpu)
    with pycolmap.Database.open(small) as few:
        pairs = {pycolmap.pair_id_to_image_pair(pair) for pair in few.read_all_matches()[0]}
    for i in names:
        if sum(i in pair for pair in pairs) < SEARCH.preselect_partners:
            pairs |= {(min(i, other), max(i, other)) for other in names if other != i}
    return [(names[a], names[b]) for a, b in sorted(pairs)]


def _candidates(job: dict[str, Any], database: Path) -> Generator[dict[str, Any]]:
    """Models to choose from, the likeliest first; each is made when it is asked for."""
    start = _calibrated_focals(database, job["seed"])
    _set_focals(database, start)
    yield _answer(job, database, "global", _global_models(job, database, "global"))
    if all(len(names) == 1 for names in job["groups"]):
        yield _answer(job, database, "incremental", _incremental_models(job, database, "incremental"))
        return
    own = database.with_suffix(".own.db")
    _write_own_cameras(database, own)
    medians = _median_focals(database, _incremental_models(job, own, "own"))
    _set_focals(database, medians)
    if any(abs(f / start.get(camera, np.inf) - 1) > SEARCH.same_focal for camera, f in medians.items()):
        yield _answer(job, database, "global from medians", _global_models(job, database, "medians"))
    yield _answer(job, database, "incremental from medians", _incremental_models(job, database, "incremental"))


def _calibrated_focals(database: Path, seed: int) -> dict[int, float]:
    """Focal length by camera: from EXIF where COLMAP read one, else from the fundamental matrices of all pairs.

    On a copy, since COLMAP also estimates the pairs anew, and with its 1 px that leaves fewer matches.
    """
    import pycolmap

    copy = database.with_suffix(".calibrated.db")
    shutil.copy(database, copy)
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


def _set_focals(database: Path, focals: dict[int, float]) -> None:
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            if camera.camera_id in focals:
                camera.params = [focals[camera.camera_id], *camera.params[1:]]
                opened.update_camera(camera)


def _write_own_cameras(database: Path, target: Path) -> None:
    """Copy a database so that each photo has a camera of its own, with the number of the photo."""
    import pycolmap

    with pycolmap.Database.open(database) as shared, pycolmap.Database.open(target) as own:
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


def _median_focals(database: Path, models: list[Any]) -> dict[int, float]:
    """Per shared camera, the median focal length of its photos in the largest of `models` with own cameras."""
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


def _global_models(job: dict[str, Any], database: Path, name: str) -> list[Any]:
    import pycolmap

    # one thread: more add sums in another order each time, and save only a tenth of the time
    options = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=job["seed"], min_model_size=3)
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    options.mapper.global_positioning.use_gpu = False
    folder = Path(job["models"]) / name
    folder.mkdir()
    return list(pycolmap.global_mapping(database, Path(job["photos"]), folder, options).values())


def _incremental_models(job: dict[str, Any], database: Path, name: str) -> list[Any]:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(num_threads=job["threads"], random_seed=job["seed"], min_model_size=3)
    folder = Path(job["models"]) / name
    folder.mkdir()
    return list(pycolmap.incremental_mapping(database, Path(job["photos"]), folder, options).values())


def _answer(job: dict[str, Any], database: Path, method: str, models: list[Any]) -> dict[str, Any]:
    """The best of `models` as plain numbers; without images where there is none.

    Its score is the share of photos with a pose times the share of verified matches that it explains.
    """
    answers = [_numbers(database, model) for model in models]
    nothing = {"images": [], "points": [], "mean_reprojection_px": 0.0, "explained": 0.0}
    photos = sum(len(names) for names in job["groups"])
    scored = [a | {"score": a["explained"] * len(a["images"]) / photos} for a in [*answers, nothing]]
    return max(scored, key=lambda a: a["score"]) | {"models": len(models), "method": method}


def _numbers(database: Path, model: Any) -> dict[str, Any]:
    """Photos, points and the share of all verified matches whose two features see one point that counts."""
    import pycolmap

    counts = {
        i for i, p in model.points3D.items() if p.track.length() >= SEARCH.min_track and p.error <= SEARCH.max_error_px
    }
    seen = {
        i: np.array([p.point3D_id if p.point3D_id in counts else -1 for p in image.points2D], dtype=np.int64)
        for i, image in model.images.items()
        if image.has_pose
    }
    seen = {i: points for i, points in seen.items() if (points >= 0).sum() >= SEARCH.min_observations}
    explained = total = 0
    with pycolmap.Database.open(database) as opened:
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair)
            matches = geometry.inlier_matches
            total += len(matches)
            if a in seen and b in seen and len(matches):
                points = seen[a][matches[:, 0]]
                explained += int(((points >= 0) & (points == seen[b][matches[:, 1]])).sum())
    return {
        "explained": explained / max(total, 1),
        "mean_reprojection_px": float(model.compute_mean_reprojection_error()),
        "images": [
            {
                "name": image.name,
                "world_from_camera": image.cam_from_world().inverse().matrix().tolist(),
                "camera": model.cameras[image.camera_id].params.tolist(),
                "camera_id": image.camera_id,
                "observations": int((seen[image.image_id] >= 0).sum()),
            }
            for image in sorted(model.images.values(), key=lambda image: image.name)
            if image.image_id in seen
        ],
        "points": [
            [*p.xyz.tolist(), *(int(c) for c in p.color), float(p.error), p.track.length()]
            for p in model.points3D.values()
        ],
    }


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
