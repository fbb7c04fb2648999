"""Refinement of a model: bundle adjustment, new poses for badly explained photos, and lenses of cropped photos.

1. Bundle adjustment of all cameras and points, and removal of outliers.
2. New poses. The global mapper poses a few photos wrongly, and the shared lens is distorted to fit them. These photos
   are removed, the others are adjusted, and each removed photo is posed from the points of the others.
3. Lenses of crops. A camera starts as COLMAP's SIMPLE_RADIAL with the principal point at the centre of the photo. In a
   crop of a larger photo it lies elsewhere. For photos of unusual size, the principal point is solved too, and then the
   four coefficients of COLMAP's OPENCV lens if that still fits better. Solving these for all photos would be ambiguous
   with the poses.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from .database import copy_with_cameras
from .job import Job, say
from .scores import ALIKE, Matches, explained_shares, lens_numbers, posed_and_explained, read_matches

_POOR_SHARE = 0.8  # photos whose explained share of matches is below this fraction of the median get a new pose
_LENS_OBSERVATIONS = 300  # fewest observed points for which a whole lens is solved: about 30 per unknown
_LENS_ROUNDS = 3  # solutions of a lens, each with the matches that the last one explains
_LENS_ERROR = 0.9  # largest ratio of mean reprojection errors, after over before, at which a solved lens is kept
_ADJUSTMENTS = 5  # most bundle adjustments in a row, each removes outliers (COLMAP: ba_global_max_refinements)
_ADJUSTED_CHANGE = 0.0005  # end below this share of changed observations (COLMAP: ba_global_max_refinement_change)


def refined(job: Job, database: Path, models: list[Any]) -> Any:
    """Refine the best of `models`, which are at least one."""
    matches, refiner = read_matches(database), _Refiner(job, database)
    start = max(models, key=lambda model: posed_and_explained(matches, model))
    best = _reposed(refiner, matches, refiner.adjusted(refiner.with_all_photos(start)))
    best = _with_own_lenses(job, database, matches, best)
    best.extract_colors_for_all_images(job.photos)
    return best


def _reposed(refiner: "_Refiner", matches: Matches, model: Any) -> Any:
    """Pose badly explained photos and photos without a pose again, as long as the score increases."""
    best, tried_before = model, set()
    while True:
        shares = explained_shares(matches, best)
        usual = float(np.median(list(shares.values()))) if shares else 0.0
        poor = [i for i, share in sorted(shares.items()) if share < _POOR_SHARE * usual]
        again = {*poor, *(i for i in best.images if not best.images[i].has_pose)}
        if again <= tried_before:
            return best
        tried_before |= again
        tried = refiner.reposed(pycolmap.Reconstruction(best), poor)
        if posed_and_explained(matches, tried) <= posed_and_explained(matches, best):
            return best
        best = tried


def _with_own_lenses(job: Job, database: Path, matches: Matches, model: Any) -> Any:
    """Solve the lenses of crops; keep a lens if its photos fit better and no fewer matches are explained.

    The first attempt has a radial distortion around the optical axis, which is right for a crop of a larger photo. The
    second has COLMAP's OPENCV lens, whose tangential part is ambiguous with the axis.
    """
    photos = _crops(model)
    images, best = [i for posed in photos.values() for i in posed], model
    for full in (False, True) if photos else ():
        lenses = _with_full_lenses(database, job.folder / "lenses.db", set(photos)) if full else database
        refiner = _Refiner(job, lenses)
        tried = refiner.with_lenses(refiner.with_all_photos(best), photos)
        fits = _mean_error_px(tried, images) <= _LENS_ERROR * _mean_error_px(best, images)
        if fits and posed_and_explained(matches, tried) >= ALIKE * posed_and_explained(matches, best):
            best = tried
    if best is not model:
        for camera, posed in photos.items():
            say(_describe_crop(best, camera, posed))
    return best


def _crops(model: Any) -> dict[int, list[int]]:
    """Return the posed photos of each camera with an unusual photo size; none if no size has the majority.

    Portrait and landscape photos of one camera count as one size. Cameras that observe too few points are left out.
    """
    images: dict[int, list[int]] = {}
    for i in sorted(model.reg_image_ids()):
        images.setdefault(model.images[i].camera_id, []).append(i)
    sizes = {i: tuple(sorted((model.cameras[i].width, model.cameras[i].height))) for i in images}
    count: dict[tuple[int, ...], int] = {}
    for camera, posed in images.items():
        count[sizes[camera]] = count.get(sizes[camera], 0) + len(posed)
    usual = max(count, key=lambda size: count[size], default=None)
    if usual is None or 2 * count[usual] <= sum(count.values()):
        return {}
    return {
        camera: posed
        for camera, posed in images.items()
        if sizes[camera] != usual and sum(model.images[i].num_points3D for i in posed) >= _LENS_OBSERVATIONS
    }


def _with_full_lenses(database: Path, target: Path, cameras: set[int]) -> Path:
    """Copy `database` to `target` and give `cameras` COLMAP's OPENCV lens."""

    def widen(camera: Any) -> None:
        if camera.camera_id in cameras:
            params = lens_numbers(camera)
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = params

    return copy_with_cameras(database, target, widen)


def _mean_error_px(model: Any, images: list[int]) -> float:
    """Compute the mean reprojection error over all observations of `images`, pixels."""
    errors: list[float] = []
    for i in images:
        image = model.images[i]
        camera, camera_from_world = model.cameras[image.camera_id], image.cam_from_world()
        seen = [point for point in image.points2D if point.has_point3D()]
        found = [camera.img_from_cam(camera_from_world * model.points3D[point.point3D_id].xyz) for point in seen]
        errors += [float(np.linalg.norm(x - p.xy)) for x, p in zip(found, seen, strict=True) if x is not None]
    return float(np.mean(errors)) if errors else float("inf")


def _describe_crop(model: Any, camera: int, images: list[int]) -> str:
    found = model.cameras[camera]
    _, _, cx, cy, *_ = lens_numbers(found)
    names = ", ".join(Path(model.images[i].name).stem for i in images)
    right, below = cx - found.width / 2, cy - found.height / 2
    across, down = "right" if right >= 0 else "left", "below" if below >= 0 else "above"
    return (
        f"{names}: size differs from most photos, so the lens was solved separately: its axis lies {abs(right):.0f} px "
        f"{across} of the middle and {abs(below):.0f} px {down} it"
    )


class _Refiner:
    """COLMAP's incremental mapper with the matches of one database."""

    def __init__(self, job: Job, database: Path) -> None:
        # one thread: several add sums in another order each time
        self._options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=job.seed)
        self._mapping = self._options.get_mapper()
        self._triangulation = self._options.get_triangulation()
        self._adjustment = self._options.get_global_bundle_adjustment()
        caching = pycolmap.DatabaseCacheOptions()
        caching.min_num_matches = self._options.min_num_matches
        with pycolmap.Database.open(database) as opened:
            self._cache = pycolmap.DatabaseCache.create(opened, caching)

    def with_all_photos(self, model: Any) -> Any:
        """Copy the model and add the photos without a pose, which mappers drop at their end.

        Cameras take the database's kind of lens, which has at least as many coefficients as the model's.
        """
        whole = pycolmap.Reconstruction()
        whole.load(self._cache)
        for i, camera in model.cameras.items():
            same = whole.cameras[i].model == camera.model
            whole.cameras[i].params = camera.params.tolist() if same else lens_numbers(camera)
        for i in sorted(model.reg_frame_ids()):
            whole.frame(i).rig_from_world = model.frame(i).rig_from_world
            whole.register_frame(i)
        for _, point in sorted(model.points3D.items()):
            whole.add_point3D(point.xyz, point.track, point.color)
        return whole

    def with_lenses(self, model: Any, photos: dict[int, list[int]]) -> Any:
        """Solve the lens and the principal point of each camera in `photos` from its own photos.

        Points and other photos are fixed at first. Then all cameras are adjusted with fixed principal points.
        """
        mapper = self._begin(model)
        options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, refine_points3D=False)
        # under a wrong lens, errors grow towards the corners; such features are not outliers
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        for images in photos.values():
            for _ in range(_LENS_ROUNDS):
                config = pycolmap.BundleAdjustmentConfig()
                for i in images:
                    config.add_image(i)
                pycolmap.create_default_bundle_adjuster(options, config, model).solve()
                for i in images:
                    mapper.triangulate_image(self._triangulation, i)
        return self._finished(mapper, model)

    def adjusted(self, model: Any) -> Any:
        """Complete and merge the tracks, adjust all cameras and points, and remove outliers."""
        mapper = self._begin(model)
        for i in sorted(model.reg_image_ids()):
            mapper.triangulate_image(self._triangulation, i)
        return self._finished(mapper, model)

    def reposed(self, model: Any, poor: list[int]) -> Any:
        """Pose the photos `poor`, and photos without a pose, from the points of the others."""
        mapper = self._begin(model)
        for i in poor:
            mapper.observation_manager.deregister_frame(model.images[i].frame_id)
        self._adjust(mapper)
        while any([self._pose(mapper, i) for i in mapper.find_next_images(self._mapping, False)]):
            pass
        return self._finished(mapper, model)

    def _pose(self, mapper: Any, image: int) -> bool:
        if not mapper.register_next_image(self._mapping, image):
            return False
        mapper.triangulate_image(self._triangulation, image)
        return True

    def _begin(self, model: Any) -> Any:
        mapper = pycolmap.IncrementalMapper(self._cache)
        mapper.begin_reconstruction(model)
        return mapper

    def _adjust(self, mapper: Any) -> None:
        mapper.iterative_global_refinement(
            _ADJUSTMENTS, _ADJUSTED_CHANGE, self._mapping, self._adjustment, self._triangulation
        )

    def _finished(self, mapper: Any, model: Any) -> Any:
        self._adjust(mapper)
        model.update_point_3d_errors()
        return model
