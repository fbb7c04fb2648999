"""The program that runs pycolmap (its only importer) in a process of its own. Knows nothing about splatgraft.

A process of its own, since pycolmap's bundled zlib corrupts the heap of one that also loads Pillow, and since its C++
checks end the process. Takes a job as JSON; writes the largest model as JSON; says what it does on stdout.
"""

import json
import sys
from pathlib import Path
from typing import Any


def main(job: dict[str, Any]) -> None:
    """Features, matches, mapping; the model goes to job["output"]."""
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)  # pyright: ignore[reportAttributeAccessIssue]
    pycolmap.set_random_seed(job["seed"])
    photos, database, device = Path(job["photos"]), Path(job["database"]), pycolmap.Device.cpu
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    extraction = pycolmap.FeatureExtractionOptions(num_threads=job["threads"], use_gpu=False)
    matching = pycolmap.FeatureMatchingOptions(num_threads=job["threads"], use_gpu=False)
    if job["thorough"]:
        extraction.sift.estimate_affine_shape = True
        extraction.sift.domain_size_pooling = True
        extraction.sift.peak_threshold = 0.003
        extraction.sift.max_num_features = 12000
        matching.sift.max_ratio = 0.85
        matching.guided_matching = True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job["seed"]
    mode = getattr(pycolmap.CameraMode, job["camera_mode"])
    say(0, "finding features")
    pycolmap.extract_features(
        database, photos, camera_mode=mode, reader_options=reader, extraction_options=extraction, device=device
    )
    say(1, "matching")
    match = pycolmap.match_exhaustive if job["exhaustive"] else pycolmap.match_sequential
    match(database, matching, verification_options=verification, device=device)
    say(2, "mapping")
    pipeline = pycolmap.IncrementalPipelineOptions(
        num_threads=job["threads"], random_seed=job["seed"], min_model_size=3
    )
    models = pycolmap.incremental_mapping(database, photos, Path(job["models"]), pipeline)
    Path(job["output"]).write_text(json.dumps(largest(list(models.values()))))


def say(done: int, what: str) -> None:
    """Tell the parent how many of three phases are done."""
    print(f"{done} {what}", flush=True)


def largest(models: list[Any]) -> dict[str, Any]:
    """The model with most images, as plain numbers; without images where there is none."""
    if not models:
        return {"models": 0, "images": [], "points": [], "mean_reprojection_px": 0.0}
    model = max(models, key=lambda m: m.num_reg_images())
    return {
        "models": len(models),
        "mean_reprojection_px": float(model.compute_mean_reprojection_error()),
        "images": [
            {
                "name": image.name,
                "world_from_camera": image.cam_from_world().inverse().matrix().tolist(),
                "camera": model.cameras[image.camera_id].params.tolist(),
            }
            for image in sorted(model.images.values(), key=lambda image: image.name)
            if image.has_pose
        ],
        "points": [
            [*point.xyz.tolist(), *(int(c) for c in point.color), float(point.error), point.track.length()]
            for point in model.points3D.values()
        ],
    }


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
