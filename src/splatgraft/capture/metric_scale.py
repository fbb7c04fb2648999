"""Metric scale of a capture, metres per world unit: from a known length, or from a square marker in the images.

Points are triangulated by least squares from pixels in several images. Markers are AprilTags and ArUco markers from
OpenCV's dictionaries.
"""

from collections import defaultdict
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.project.metric_scale import MetricScale
from splatgraft.runtime.progress import Progress, silent

_DICTIONARIES = (
    "DICT_APRILTAG_36h11",
    "DICT_APRILTAG_25h9",
    "DICT_4X4_50",
    "DICT_5X5_100",
    "DICT_6X6_250",
    "DICT_7X7_250",
    "DICT_ARUCO_ORIGINAL",
)
"""Common dictionaries; a larger dictionary of the same family begins with the same markers."""
_MAX_MISS_PX = 3.0  # largest reprojection error of a corner: detection is right to 1 px, plausible poses to 1 or 2
_MIN_ANGLE = 1e-4  # smallest sum of squared sines of the angles between rays: one degree between two rays


def triangulate(cameras: Cameras, pixels: Float[Tensor, "v 2"]) -> tuple[Float[Tensor, "3"], float]:
    """Triangulate a point from one pixel (x, y) in each of two or more cameras, by least squares.

    Returns:
        The point, world units, and its mean reprojection error, pixels.

    Raises:
        ValueError: The rays are almost parallel.
    """
    homogeneous = torch.cat([pixels.double(), torch.ones(len(pixels), 1, dtype=torch.float64)], 1)[..., None]
    in_camera = torch.linalg.inv(cameras.intrinsics.double()) @ homogeneous
    rays = torch.nn.functional.normalize((cameras.world_from_camera[:, :3, :3].double() @ in_camera)[..., 0], dim=1)
    across = torch.eye(3, dtype=torch.float64) - rays[:, :, None] * rays[:, None, :]
    if float(torch.linalg.eigvalsh(across.sum(0))[0]) < _MIN_ANGLE:
        names = ", ".join(cameras.names)
        raise ValueError(f"point: expected images from different directions, found almost the same in {names}")
    point = torch.linalg.solve(across.sum(0), (across @ cameras.centers.double()[..., None])[..., 0].sum(0))
    seen = torch.stack([camera.project(point)[0] for camera in cameras])
    return point.float(), float((seen - pixels).norm(dim=1).mean())


def scale_from_length(ends: tuple[Float[Tensor, "3"], Float[Tensor, "3"]], metres: float) -> MetricScale:
    """Compute the scale at which the distance between two points, world units, is `metres`."""
    distance = float((ends[0] - ends[1]).norm())
    if not (distance > 0 and metres > 0):
        raise ValueError(f"--length: expected two points apart and metres above 0, found {distance:g} and {metres:g}")
    return MetricScale(metres / distance, f"a length of {metres:g} m between two points")


def scale_from_marker(
    images: Sequence[Float[Tensor, "_ _ 3"]],
    cameras: Cameras,
    side_m: float,
    *,
    progress: Progress = silent,
) -> MetricScale:
    """Compute the scale at which the black square of the marker seen in most images has sides of `side_m` metres.

    Args:
        images: sRGB in [0, 1].
        cameras: One camera per image.
        side_m: Side of the black square, metres.
        progress: Called with images done, images in all and a short text.

    Raises:
        ValueError: No marker is seen in two images, or its corners do not meet.
    """
    seen = _marker_corners(images, progress)
    several = {key: views for key, views in seen.items() if len(views) >= 2}
    if not several:
        raise ValueError(
            f"--marker: expected an AprilTag or ArUco marker in two images, found {len(seen)} in one image"
        )
    key, views = max(several.items(), key=lambda item: len(item[1]))
    chosen = cameras[sorted(views)]
    corners = torch.stack([torch.from_numpy(views[i]) for i in sorted(views)])
    found = [triangulate(chosen, corners[:, corner]) for corner in range(4)]
    miss = max(miss_px for _, miss_px in found)
    if miss > _MAX_MISS_PX:
        raise ValueError(f"--marker: expected corners that meet within {_MAX_MISS_PX:g} px, found {miss:.1f} px")
    points = torch.stack([point for point, _ in found])
    sides = (points - points.roll(-1, 0)).norm(dim=1)
    spread = float((sides.amax() - sides.amin()) / sides.mean())
    name = f"{key[0].removeprefix('DICT_')} marker {key[1]} of {side_m:g} m in {len(views)} images"
    return MetricScale(side_m / float(sides.mean()), f"{name}, sides equal within {spread:.0%}")


def _marker_corners(
    images: Sequence[Float[Tensor, "_ _ 3"]], progress: Progress
) -> dict[tuple[str, int], dict[int, Float[np.ndarray, "4 2"]]]:
    """Find marker corners, by dictionary and id of the marker and then by image; pixel centres are at 0.5."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detectors = {
        name: cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)), parameters)
        for name in _DICTIONARIES
    }
    seen: dict[tuple[str, int], dict[int, np.ndarray]] = defaultdict(dict)
    for index, image in enumerate(images):
        progress(index, len(images), "looking for markers")
        grey = cv2.cvtColor((image.clamp(0, 1) * 255).round().to(torch.uint8).numpy(), cv2.COLOR_RGB2GRAY)
        for name, detector in detectors.items():
            corners, numbers, _ = detector.detectMarkers(grey)
            for four, number in zip(corners, [] if numbers is None else numbers.flatten(), strict=True):
                seen[name, int(number)][index] = four.reshape(4, 2).astype(np.float32) + 0.5
    return seen
