"""The value `Distortion`: radial and tangential lens distortion of an image (OpenCV's model), and its removal."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor


@dataclass(frozen=True)
class Distortion:
    """OpenCV's camera with k1, k2, p1, p2, k3; it includes COLMAP's SIMPLE_RADIAL, RADIAL and OPENCV."""

    intrinsics: Float64[Tensor, "3 3"]
    """Matrix of the distorted camera, pixels of `size`, pixel centres at +0.5."""
    coefficients: Float64[Tensor, "5"]
    """Coefficients k1, k2, p1, p2, k3."""
    size: tuple[int, int]
    """Width and height that `intrinsics` refer to, pixels."""

    def pinhole(self) -> Float64[np.ndarray, "3 3"]:
        """Compute the intrinsics, at `size`, of the pinhole camera with the largest view without empty border.

        Raises: ValueError if the distortion folds the image over itself.
        """
        width, height = self.size
        t = np.linspace(0, 1, 129)  # points on each edge
        zero, one = np.zeros_like(t), np.ones_like(t)
        edges = np.stack([[zero, t], [one, t], [t, zero], [t, one]]).transpose(0, 2, 1)  # left, right, top, bottom
        edges_px = (edges * (width, height)).reshape(-1, 1, 2)
        matrix, coefficients = self.intrinsics.numpy(), self.coefficients.numpy()
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-10)
        found = cv2.undistortPoints(edges_px, matrix, coefficients, None, None, None, criteria)
        rays = np.concatenate([found, np.ones_like(found[..., :1])], -1)
        back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, coefficients)
        left, right, top, bottom = found.reshape(4, -1, 2)
        x0, x1 = left[:, 0].max(), right[:, 0].min()
        y0, y1 = top[:, 1].max(), bottom[:, 1].min()
        solved = np.isfinite(found).all() and np.abs(back - edges_px).max() < 0.1
        if not (solved and x0 < x1 and y0 < y1 and self._is_monotonic(np.hypot([x0, x0, x1, x1], [y0, y1, y0, y1]))):
            numbers = ", ".join(f"{c:.4g}" for c in coefficients)
            raise ValueError(f"expected a distortion that can be undone, found k1, k2, p1, p2, k3 = {numbers}")
        fx, fy = width / (x1 - x0), height / (y1 - y0)
        return np.array([[fx, 0, -x0 * fx], [0, fy, -y0 * fy], [0, 0, 1]])

    def _is_monotonic(self, radii: np.ndarray) -> bool:
        """Whether the distorted radius grows with the undistorted one, up to the largest of `radii`."""
        k1, k2, _, _, k3 = self.coefficients.tolist()
        square = np.linspace(0, radii.max(), 256) ** 2
        return bool((1 + square * (3 * k1 + square * (5 * k2 + square * 7 * k3)) > 0).all())

    def undistort(
        self, image: Float[Tensor, "h w *c"], pinhole: Float[Tensor, "3 3"], *, width: int, height: int
    ) -> Float[Tensor, "h w *c"]:
        """Resample `image`, at its own resolution, to the view of a pinhole camera of `width` x `height` pixels."""
        h, w = image.shape[:2]
        half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV has pixel centres at whole numbers
        to_file = np.diag([w / self.size[0], h / self.size[1], 1])
        to_pinhole = np.diag([w / width, h / height, 1])
        map_x, map_y = cv2.initUndistortRectifyMap(
            to_file @ self.intrinsics.numpy() - half,
            self.coefficients.numpy(),
            None,
            to_pinhole @ pinhole.double().cpu().numpy() - half,
            (w, h),
            cv2.CV_32FC1,
        )
        pixels = image.contiguous().numpy()
        # samples beyond the outermost pixel centres lie at most half a pixel out: repeat the border
        moved = cv2.remap(pixels, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return torch.from_numpy(moved).reshape(image.shape)

    def undistort_points(self, points: Float[Tensor, "k 2"], pinhole: Float[Tensor, "3 3"]) -> Float[Tensor, "k 2"]:
        """Map `points` (x, y) of the distorted picture, pixels of `size`, to pixels of a pinhole camera."""
        if not len(points):
            return points
        found = cv2.undistortPoints(
            points.double().cpu().numpy().reshape(-1, 1, 2),
            self.intrinsics.numpy(),
            self.coefficients.numpy(),
            None,
            None,
            pinhole.double().cpu().numpy(),
            (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-10),
        )
        return torch.from_numpy(found.reshape(-1, 2)).to(points)
