"""Refinement of a model: outliers dropped, all cameras adjusted, and the photos that it explains worst posed anew.

The global mapper places all photos at once, and a few of them wrongly, towards which the shared lens bends. Such photos
are taken out, the rest is adjusted, and each is posed from the points of the rest.

A camera starts as COLMAP's SIMPLE_RADIAL with the principal point in the middle of the photo. In a photo cut out of a
larger one it lies elsewhere, and a radial distortion around the middle bends to make up for it. Of photos that are not
as large as the others, the principal point is solved as well, and where that is not enough the four numbers of OPENCV's
distortion: for all photos these would trade against the poses.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from .database import copy_with_cameras
from .job import Job, say
from .scores import ALIKE, Matches, explained_shares, lens_numbers, posed_and_explained, read_matches

_POOR_SHARE = 0.8  # A photo with less than this of the median photo's share of matches explained is posed anew
_LENS_OBSERVATIONS = 300
"""Points that the photos of one camera must see for its whole lens to be solved: 30 for each of its numbers."""
_LENS_ROUNDS = 3  # how often a lens is solved, each time with the matches that the last one explains
_LENS_ERROR = 0.9  # share to which the mean reprojection error of these photos must fall for their lenses to be taken
_ADJUSTMENTS = 5
"""The most bundle adjustments in a row, each followed by dropping outliers (COLMAP: ba_global_max_refinements)."""
_ADJUSTED_CHANGE = 0.0005
"""Share of observations that changed below which they end (COLMAP: ba_global_max_refinement_change)."""


def refined(job: Job, database: Path, models: list[Any]) -> Any:
    """The best of `models`, of which there is at least one, refined."""
    matches, refiner = read_matches(database), _Refiner(job, database)
    start = max(models, key=lambda model: posed_and_explained(matches, model))
    best = _reposed(refiner, matches, refiner.adjusted(refiner.with_all_photos(start)))
    best = _with_own_lenses(job, database, matches, best)
    best.extract_colors_for_all_images(job.photos)
    return best


def _reposed(refiner: "_Refiner", matches: Matches, model: Any) -> Any:
    """The model with badly explained photos, and those without a pose, posed anew as long as the score grows."""
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
    """The model with the lenses of crops solved, where these photos then fit better and no fewer matches do.

    With a radial distortion around the optical axis first, which is right where a photo was cut out of a larger one;
    with OPENCV's, whose tangential part trades against the axis, where that fits better still.
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
    """Posed photos by camera, of the cameras whose photos have another size than most; none where these are not fewer.

    A photo taken upright has the size of one taken across. A camera whose photos see too few points is left out.
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
    """A copy of `database` at `target` in which `cameras` have OPENCV's lens."""

    def widen(camera: Any) -> None:
        if camera.camera_id in cameras:
            params = lens_numbers(camera)
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = params

    return copy_with_cameras(database, target, widen)


def _mean_error_px(model: Any, images: list[int]) -> float:
    """Mean reprojection error over what the photos see, pixels."""
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
        f"{names}: of another size than most photos, so the lens was solved apart: its axis lies {abs(right):.0f} px "
        f"{across} of the middle and {abs(below):.0f} px {down} it"
    )


class _Refiner:
    """COLMAP's incremental mapper with the matches of one database."""

    def __init__(self, job: Job, database: Path) -> None:
        # one thread: more add sums in another order each time
        self._options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=job.seed)
        self._mapping = self._options.get_mapper()
        self._triangulation = self._options.get_triangulation()
        self._adjustment = self._options.get_global_bundle_adjustment()
        caching = pycolmap.DatabaseCacheOptions()
        caching.min_num_matches = self._options.min_num_matches
        with pycolmap.Database.open(database) as opened:
            self._cache = pycolmap.DatabaseCache.create(opened, caching)

    def with_all_photos(self, model: Any) -> Any:
        """A copy of the model that also has the photos without a pose, which mappers drop when they end.

        Its cameras have the kind of lens that the database says, which is the same or a fuller one.
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
        """The model with a lens solved for each of the cameras in `photos`, with its principal point, from its photos.

        All else is held until the lens is right; then all cameras are adjusted, these with their principal point held.
        """
        mapper = self._begin(model)
        options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, refine_points3D=False)
        # features far from the wrong lens's middle are off by more than others, and are no outliers
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
        """The model with tracks completed and merged, all cameras and points adjusted, and outliers dropped."""
        mapper = self._begin(model)
        for i in sorted(model.reg_image_ids()):
            mapper.triangulate_image(self._triangulation, i)
        return self._finished(mapper, model)

    def reposed(self, model: Any, poor: list[int]) -> Any:
        """The model with its photos `poor`, and those without a pose, posed from the points of the others."""
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
