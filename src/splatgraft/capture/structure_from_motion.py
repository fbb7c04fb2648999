"""Poses for photos that have none, by pycolmap (its only importer). Knows nothing about Gaussians or projects."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import cv2
import numpy as np
import torch
from PIL import Image, ImageOps

from splatgraft.cameras import Cameras
from splatgraft.capture.orientation import upright
from splatgraft.images import read_rgb, write_image
from splatgraft.posed_images import PosedImages
from splatgraft.progress import Progress, silent

_EXIF_ORIENTATION = 0x0112
_ADVICE = (
    "take more photos with at least two thirds overlap, a step apart, sharp, of a still scene; shiny or plain things "
    "need textured surroundings; one zoom setting throughout (or cameras='each')"
)


@dataclass(frozen=True)
class PoseOptions:
    """How structure from motion is run."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which pairs are compared: all, or neighbours in name order; `auto` is exhaustive for up to 80 photos."""
    effort: Literal["auto", "quick", "thorough"] = "auto"
    """`thorough` finds and matches many more features, at about 20 times the cost; `auto` does so if quick misses any."""
    cameras: Literal["shared", "each"] = "shared"
    """Whether all photos of one size come from one camera at one zoom setting."""
    max_size_px: int = 1600
    """Larger photos are shrunk to this longest side first."""
    threads: int = 2
    """CPU threads."""
    seed: int = 0
    """For the random choices of geometric verification and mapping."""


@dataclass(frozen=True)
class PoseReport:
    """How well it went."""

    photos: int
    """Photos given."""
    registered: int
    """Photos with a pose."""
    missing: tuple[str, ...]
    """Names of the photos without."""
    mean_reprojection_px: float
    """Mean distance between where points are seen and where they project, pixels of the (shrunk) photos."""
    points: int
    """Sparse points."""
    models: int
    """Separate models found; the largest was taken."""

    def __str__(self) -> str:
        """One line for people."""
        return (
            f"{self.registered} of {self.photos} photos registered, {self.points} points, "
            f"mean reprojection error {self.mean_reprojection_px:.2f} px"
        )


def pose_photos(
    photos: Sequence[Path], workspace: Path, *, options: PoseOptions = PoseOptions(), progress: Progress = silent
) -> tuple[PosedImages, PoseReport]:
    """Poses, intrinsics and sparse points of `photos`; undistorted images are written to `workspace`/images.

    World: +z up, support plane at z = 0, median camera distance 1 (see `upright`). Workspace also keeps the COLMAP
    database and model.

    Raises: ValueError where pycolmap is missing, names clash, a photo is unreadable, or under half could be posed.
    """
    pycolmap = _import_pycolmap()
    if len(photos) < 3:
        raise ValueError(f"{workspace}: expected at least 3 photos to pose, found {len(photos)}")
    efforts = ("quick", "thorough") if options.effort == "auto" else (options.effort,)
    total = 1 + 3 * len(efforts) + 1
    progress(0, total, "reading photos")
    names = _working_copies(photos, workspace / "photos", options.max_size_px)
    models: dict[int, Any] = {}
    for attempt, effort in enumerate(efforts):
        found = _reconstruct(
            pycolmap, workspace, options, effort, lambda n, m, a=attempt: progress(1 + 3 * a + n, total, m)
        )
        models = max(models, found, key=_largest_size)
        if _largest_size(models) == len(photos):
            break
    registered = _largest_size(models)
    if registered < 0.5 * len(photos):
        raise ValueError(
            f"{workspace}: expected at least half of {len(photos)} photos to register, found {registered}; {_ADVICE}"
        )
    model = max(models.values(), key=lambda m: m.num_reg_images())
    progress(total - 1, total, "undistorting")
    posed = _posed_images(model, workspace)
    upright_from_sfm = upright(posed.cameras, posed.points)
    posed = PosedImages(
        image_paths=posed.image_paths,
        cameras=upright_from_sfm.cameras(posed.cameras),
        points=upright_from_sfm.points(posed.points),
        point_colors=posed.point_colors,
    )
    report = PoseReport(
        photos=len(photos),
        registered=registered,
        missing=tuple(sorted(set(names) - {image.name for image in model.images.values()})),
        mean_reprojection_px=float(model.compute_mean_reprojection_error()),
        points=len(posed.points),
        models=len(models),
    )
    progress(total, total, str(report))
    return posed, report


def _import_pycolmap() -> ModuleType:
    try:
        import pycolmap
    except ImportError as error:
        raise ValueError(
            "photos without poses: expected pycolmap to be installed (pip install 'splatgraft[sfm]'), found none"
        ) from error
    return pycolmap


def _largest_size(models: dict[int, Any]) -> int:
    return max((model.num_reg_images() for model in models.values()), default=0)


def _working_copies(photos: Sequence[Path], folder: Path, max_size_px: int) -> list[str]:
    """Upright, shrunk copies that keep the EXIF focal length; COLMAP itself ignores the rotation tag."""
    names = [photo.stem + ".jpg" for photo in photos]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{photos[0].parent}: expected one photo per name, found several of {Path(twice[0]).stem!r}")
    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.iterdir():
        if stale.name not in names:
            stale.unlink()
    for photo, name in zip(photos, names, strict=True):
        read_rgb(photo)  # one place words the errors of unreadable images
        with Image.open(photo) as image:
            exif = image.getexif()
            exif[_EXIF_ORIENTATION] = 1
            copy = ImageOps.exif_transpose(image).convert("RGB")
        copy.thumbnail((max_size_px, max_size_px), Image.Resampling.LANCZOS)
        copy.save(folder / name, quality=97, subsampling=0, exif=exif)
    return names


def _reconstruct(
    pycolmap: ModuleType, workspace: Path, options: PoseOptions, effort: str, progress: Any
) -> dict[int, Any]:
    pycolmap.set_random_seed(options.seed)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR
    database = workspace / f"{effort}.db"
    database.unlink(missing_ok=True)
    photos, device = workspace / "photos", pycolmap.Device.cpu
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu = options.threads, False
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = options.threads, False
    if effort == "thorough":
        extraction.sift.estimate_affine_shape = True
        extraction.sift.domain_size_pooling = True
        extraction.sift.peak_threshold = 0.003
        extraction.sift.max_num_features = 12000
        matching.sift.max_ratio = 0.85
        matching.guided_matching = True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    progress(0, f"features ({effort})")
    mode = pycolmap.CameraMode.AUTO if options.cameras == "shared" else pycolmap.CameraMode.PER_IMAGE
    sizes = {Image.open(photo).size for photo in photos.iterdir()}
    if options.cameras == "shared" and len(sizes) == 1:
        mode = pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(
        database, photos, camera_mode=mode, reader_options=reader, extraction_options=extraction, device=device
    )
    progress(1, f"matching ({effort})")
    exhaustive = options.matching == "exhaustive" or (options.matching == "auto" and len(list(photos.iterdir())) <= 80)
    match = pycolmap.match_exhaustive if exhaustive else pycolmap.match_sequential
    match(database, matching, verification_options=verification, device=device)
    progress(2, f"mapping ({effort})")
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads, pipeline.random_seed = options.threads, options.seed
    pipeline.min_model_size = 3
    output = workspace / f"sparse_{effort}"
    output.mkdir(exist_ok=True)
    return pycolmap.incremental_mapping(database, photos, output, pipeline)


def _posed_images(model: Any, workspace: Path) -> PosedImages:
    folder = workspace / "images"
    folder.mkdir(exist_ok=True)
    for stale in folder.iterdir():
        stale.unlink()
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    poses, intrinsics, sizes, paths = [], [], [], []
    for image in images:
        rgb = read_rgb(workspace / "photos" / image.name)
        pixels, matrix = _undistort(rgb.numpy(), model.cameras[image.camera_id])
        path = folder / (Path(image.name).stem + ".png")
        write_image(path, torch.from_numpy(pixels))
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        poses.append(pose)
        intrinsics.append(matrix)
        sizes.append([rgb.shape[1], rgb.shape[0]])
        paths.append(path)
    points = list(model.points3D.values())
    return PosedImages(
        image_paths=tuple(paths),
        cameras=Cameras(
            world_from_camera=torch.from_numpy(np.stack(poses)).float(),
            intrinsics=torch.from_numpy(np.stack(intrinsics)).float(),
            sizes=torch.tensor(sizes),
            names=tuple(path.name for path in paths),
        ),
        points=torch.tensor(np.array([p.xyz for p in points]).reshape(-1, 3)).float(),
        point_colors=torch.tensor(np.array([p.color for p in points]).reshape(-1, 3)).float() / 255,
    )


def _undistort(rgb: np.ndarray, camera: Any) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of the ideal pinhole with the widest view that leaves no blank border, and its matrix."""
    f, cx, cy, k = camera.params
    h, w = rgb.shape[:2]
    # OpenCV puts pixel centres at whole numbers, COLMAP and we at halves
    distorted = np.array([[f, 0, cx - 0.5], [0, f, cy - 0.5], [0, 0, 1]])
    coefficients = np.array([k, 0, 0, 0])
    x, y = np.linspace(0, w - 1, 65), np.linspace(0, h - 1, 65)
    left, right, top, bottom = (
        cv2.undistortPoints(np.stack(np.broadcast_arrays(u, v), -1)[:, None], distorted, coefficients)[:, 0]
        for u, v in ((0.0, y), (w - 1.0, y), (x, 0.0), (x, h - 1.0))
    )
    focal = max(
        (w / 2 - 0.5) / min(right[:, 0].min(), -left[:, 0].max()),
        (h / 2 - 0.5) / min(bottom[:, 1].min(), -top[:, 1].max()),
    )
    ideal = np.array([[focal, 0, w / 2], [0, focal, h / 2], [0, 0, 1]])
    shifted = ideal - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    maps = cv2.initUndistortRectifyMap(distorted, coefficients, None, shifted, (w, h), cv2.CV_32FC1)
    return cv2.remap(rgb, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), ideal
