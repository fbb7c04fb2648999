"""The arrays of a viser node of splats, computed with numpy alone so that the first ones need not wait for torch."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_C0 = 0.28209479177387814
"""The constant of band 0 of the spherical harmonics, as in `core.spherical_harmonics`, which needs torch."""
_HALF_MAX = 6e4
"""Just below the largest number of half precision, in which viser stores covariances."""
_LOG_MAX = 20.0
"""Logarithm of a scale whose square is beyond half precision, and within single precision."""


@dataclass(frozen=True)
class SplatArrays:
    """Splats in a frame that is scaled so that their covariances fit half precision; the node scales them back."""

    centers: Float[np.ndarray, "m 3"]
    """Centres, in units of `unit`."""
    covariances: Float[np.ndarray, "m 3 3"]
    """Covariances, in units of `unit` squared."""
    rgbs: Float[np.ndarray, "m 3"]
    """sRGB in [0, 1]."""
    opacities: Float[np.ndarray, "m 1"]
    """Opacity in [0, 1]."""
    unit: float
    """World units per unit of the node."""


def splat_arrays(
    means: Float[np.ndarray, "m 3"],
    log_scales: Float[np.ndarray, "m 3"],
    quaternions: Float[np.ndarray, "m 4"],
    *,
    opacity_logits: Float[np.ndarray, "m"],
    band_0: Float[np.ndarray, "m 3"],
) -> SplatArrays:
    """The arrays of at least one Gaussian, in the raw parametrisation of `core.gaussians.Gaussians`."""
    unit = float(np.exp(np.median(log_scales))) * 10
    scales = np.exp(np.minimum(log_scales - np.float32(np.log(unit)), _LOG_MAX))
    half = _rotations(quaternions) * scales[:, None, :]
    covariances = np.einsum("mij,mkj->mik", half, half).clip(-_HALF_MAX, _HALF_MAX)
    with np.errstate(over="ignore"):  # exp of a large logit is infinite, and its opacity 0
        opacities = 1 / (1 + np.exp(-opacity_logits))
    return SplatArrays(
        centers=means / np.float32(unit),
        covariances=covariances,
        rgbs=(0.5 + np.float32(_C0) * band_0).clip(0, 1),
        opacities=opacities[:, None],
        unit=unit,
    )


def _rotations(quaternions: Float[np.ndarray, "m 4"]) -> Float[np.ndarray, "m 3 3"]:
    """Own axes as columns, of quaternions wxyz of any length but zero."""
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    w, x, y, z = (quaternions / np.maximum(lengths, np.float32(1e-12))).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
