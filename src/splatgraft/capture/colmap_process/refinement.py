"""Refinement of a model: outliers dropped, all cameras adjusted, and the photos that it explains worst posed anew.

The global mapper places all photos at once, and a few of them wrongly: on 73 photos of a bonsai eight had 28% to 59% of
their matches explained where 74% is usual. The lens that all photos share bends towards them (836 px with, 827 px
without them). Such photos are taken out, the rest is adjusted, and each is posed from the points of the rest.
"""

from pathlib import Path
from typing import Any

import numpy as np

from .job import SEARCH, Job
from .joining import joined
from .scores import Matches, explained_shares, posed_and_explained, read_matches


def refined(job: Job, database: Path, models: list[Any]) -> Any:
    """The best of `models`, of which there is at least one, with what others of them add to it, refined."""
    matches, refiner = read_matches(database), _Refiner(job, database)
    start = joined(models) or max(models, key=lambda model: posed_and_explained(matches, model))
    best = _reposed(refiner, matches, refiner.adjusted(refiner.with_all_photos(start)))
    best.extract_colors_for_all_images(job.photos)
    return best


def _reposed(refiner: "_Refiner", matches: Matches, model: Any) -> Any:
    """The model with badly explained photos, and those without a pose, posed anew as long as the score grows."""
    import pycolmap

    best, tried_before = model, set()
    while True:
        shares = explained_shares(matches, best)
        usual = float(np.median(list(shares.values()))) if shares else 0.0
        poor = [i for i, share in sorted(shares.items()) if share < SEARCH.poor_share * usual]
        again = {*poor, *(i for i in best.images if not best.images[i].has_pose)}
        if again <= tried_before:
            return best
        tried_before |= again
        tried = refiner.reposed(pycolmap.Reconstruction(best), poor)
        if posed_and_explained(matches, tried) <= posed_and_explained(matches, best):
            return best
        best = tried


class _Refiner:
    """COLMAP's incremental mapper with the matches of one database."""

    def __init__(self, job: Job, database: Path) -> None:
        import pycolmap

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
        """A copy of the model that also has the photos without a pose, which mappers drop when they end."""
        import pycolmap

        whole = pycolmap.Reconstruction()
        whole.load(self._cache)
        for i, camera in model.cameras.items():
            whole.cameras[i].params = camera.params
        for i in sorted(model.reg_frame_ids()):
            whole.frame(i).rig_from_world = model.frame(i).rig_from_world
            whole.register_frame(i)
        for _, point in sorted(model.points3D.items()):
            whole.add_point3D(point.xyz, point.track, point.color)
        return whole

    def adjusted(self, model: Any) -> Any:
        """The model with tracks completed and merged, all cameras and points adjusted, and outliers dropped."""
        mapper = self._begin(model)
        for i in sorted(model.reg_image_ids()):
            mapper.triangulate_image(self._triangulation, i)
        self._adjust(mapper)
        model.update_point_3d_errors()
        return model

    def reposed(self, model: Any, poor: list[int]) -> Any:
        """The model with its photos `poor`, and those without a pose, posed from the points of the others."""
        mapper = self._begin(model)
        for i in poor:
            mapper.observation_manager.deregister_frame(model.images[i].frame_id)
        self._adjust(mapper)
        while True:
            posed = [i for i in mapper.find_next_images(self._mapping, False) if self._pose(mapper, i)]
            if not posed:
                break
        self._adjust(mapper)
        model.update_point_3d_errors()
        return model

    def _pose(self, mapper: Any, image: int) -> bool:
        if not mapper.register_next_image(self._mapping, image):
            return False
        mapper.triangulate_image(self._triangulation, image)
        return True

    def _begin(self, model: Any) -> Any:
        import pycolmap

        mapper = pycolmap.IncrementalMapper(self._cache)
        mapper.begin_reconstruction(model)
        return mapper

    def _adjust(self, mapper: Any) -> None:
        mapper.iterative_global_refinement(
            SEARCH.adjustments, SEARCH.adjusted_change, self._mapping, self._adjustment, self._triangulation
        )
