"""COLMAP's incremental mapper as a means to refine a model: all cameras adjusted, photos posed anew."""

from pathlib import Path
from typing import Any

from .job import SEARCH, Job
from .lenses import params_as


class Refiner:
    """COLMAP's incremental mapper with the matches of one database."""

    def __init__(self, job: Job, database: Path) -> None:
        """Read the matches of `database`."""
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
        """A copy of the model that also has the photos without a pose, which mappers drop when they end.

        Its cameras have the kind of lens that the database says.
        """
        import pycolmap

        whole = pycolmap.Reconstruction()
        whole.load(self._cache)
        for i, camera in model.cameras.items():
            whole.cameras[i].params = params_as(whole.cameras[i], camera)
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
        for images in photos.values():
            for _ in range(SEARCH.lens_rounds):
                self._solve_lens(model, images)
                for i in images:
                    mapper.triangulate_image(self._triangulation, i)
        self._adjust(mapper)
        model.update_point_3d_errors()
        return model

    def _solve_lens(self, model: Any, images: list[int]) -> None:
        """Adjust the poses of `images` and their camera with its principal point to the points as they are."""
        import pycolmap

        options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, refine_points3D=False)
        # features far from the wrong lens's middle are off by more than others, and are no outliers
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        config = pycolmap.BundleAdjustmentConfig()
        for i in images:
            config.add_image(i)
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()

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
