"""The linear map from SH coefficients to colours towards one view, and its transpose, for the Gaussians it shows.

On the CPU numba kernels evaluate the basis of one Gaussian at a time, without an array of the coefficients' size.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.fitting import adam
from splatgraft.rendering.cpu_basis import basis_at
from splatgraft.runtime.kernels import kernel, serialized

_PART = 512  # gaussians of one task of a kernel
_MAX_COEFFICIENTS = 16  # coefficients of degree 3


@dataclass(frozen=True)
class Expansion:
    """Spherical harmonics of m Gaussians towards one camera."""

    means: Float[Tensor, "m 3"]
    """Centres, world units; shared by all views."""
    center: Float[Tensor, "3"]
    """Centre of the camera, world units."""
    shown: Int[Tensor, "s"]
    """Indices of the Gaussians with weight in the view, ascending int32; the map is 0 for the others."""
    degree: int
    """Degree of the harmonics."""

    def colors(self, sh: Float[Tensor, "m k 3"]) -> Float[Tensor, "m 3"]:
        """Compute the sum of harmonics times coefficients."""
        out = sh.new_zeros(len(sh), 3)
        if self._on_cpu:
            _fill_colors(*self._numbers, sh.contiguous().numpy(), out.numpy())
        else:
            out[self.shown] = torch.einsum("mk,mkc->mc", self._basis(self.shown), sh[self.shown])
        return out

    def add_transpose(self, colors: Float[Tensor, "m 3"], out: Float[Tensor, "m k 3"]) -> None:
        """Apply the transpose of the map to `colors` and add the result to `out`."""
        if self._on_cpu:
            _add_transpose(*self._numbers, colors.contiguous().numpy(), out.numpy())
        else:
            out[self.shown] += self._basis(self.shown)[:, :, None] * colors[self.shown][:, None, :]

    def descend(
        self,
        sh: Float[Tensor, "m k 3"],
        colors: Float[Tensor, "m 3"],
        *,
        moments: adam.Moments,
        rates: Float[Tensor, "3*k"],
    ) -> bool:
        """Take one step of `adam.step` on the shown coefficients, given the gradient by colours.

        It changes `sh` and the moments of the field "sh" in place. It returns False if a gradient was not finite; such
        rows stay.
        """
        if self._on_cpu:
            flat = tuple(x.view(len(x), -1).numpy() for x in (sh, moments.first["sh"], moments.second["sh"]))
            numbers = colors.contiguous().numpy(), flat, moments.steps.numpy(), rates.numpy()
            return _descend(self._numbers, *numbers) == 0
        gradient = torch.zeros_like(sh)
        self.add_transpose(colors, gradient)
        visible = torch.zeros(len(sh), dtype=torch.bool, device=sh.device)
        visible[self.shown] = True
        return adam.step({"sh": sh}, {"sh": gradient}, moments=moments, rates={"sh": rates}, visible=visible)

    def add_squares(self, weights: Float[Tensor, "m 1"], out: Float[Tensor, "m k k"]) -> None:
        """Add weight times harmonics times their transpose, for every Gaussian, to `out`."""
        if self._on_cpu:
            _add_squares(*self._numbers, weights.contiguous().numpy(), out.numpy())
        else:
            basis = self._basis(self.shown)
            out[self.shown] += (weights[self.shown] * basis)[:, :, None] * basis[:, None, :]

    @property
    def _on_cpu(self) -> bool:
        return self.means.device.type == "cpu"

    @property
    def _numbers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.means.numpy(), self.center.numpy(), self.shown.numpy()

    def _basis(self, which: Tensor) -> Float[Tensor, "s k"]:
        directions = torch.nn.functional.normalize(self.means[which] - self.center, dim=-1)
        return spherical_harmonics.basis(directions, self.degree)


@kernel
@no_type_check
def _basis_towards(mean, center, k, out):
    x, y, z = float(mean[0]) - center[0], float(mean[1]) - center[1], float(mean[2]) - center[2]
    over = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
    basis_at(x * over, y * over, z * over, k, out)


@serialized
@kernel(parallel=True)
@no_type_check
def _fill_colors(means, center, shown, sh, out):
    n, k = shown.shape[0], sh.shape[1]
    for part in numba.prange((n + _PART - 1) // _PART):
        basis = np.empty(_MAX_COEFFICIENTS, np.float32)
        for i in range(part * _PART, min(n, (part + 1) * _PART)):
            g = shown[i]
            _basis_towards(means[g], center, k, basis)
            red, green, blue = np.float32(0), np.float32(0), np.float32(0)
            for j in range(k):
                red += basis[j] * sh[g, j, 0]
                green += basis[j] * sh[g, j, 1]
                blue += basis[j] * sh[g, j, 2]
            out[g, 0], out[g, 1], out[g, 2] = red, green, blue


@serialized
@kernel(parallel=True)
@no_type_check
def _add_transpose(means, center, shown, colors, out):
    n, k = shown.shape[0], out.shape[1]
    for part in numba.prange((n + _PART - 1) // _PART):
        basis = np.empty(_MAX_COEFFICIENTS, np.float32)
        for i in range(part * _PART, min(n, (part + 1) * _PART)):
            g = shown[i]
            _basis_towards(means[g], center, k, basis)
            for j in range(k):
                for c in range(3):
                    out[g, j, c] += basis[j] * colors[g, c]


@serialized
@kernel(parallel=True)
@no_type_check
def _add_squares(means, center, shown, weights, out):
    n, k = shown.shape[0], out.shape[1]
    for part in numba.prange((n + _PART - 1) // _PART):
        basis = np.empty(_MAX_COEFFICIENTS, np.float32)
        for i in range(part * _PART, min(n, (part + 1) * _PART)):
            g = shown[i]
            _basis_towards(means[g], center, k, basis)
            for a in range(k):
                scaled = weights[g, 0] * basis[a]
                for b in range(k):
                    out[g, a, b] += scaled * basis[b]


@serialized
@kernel(parallel=True)
@no_type_check
def _descend(seen, colors, rows, steps, rates):
    """Apply `_add_transpose` and `adam.update_row` row by row; returns the number of rows that are not finite."""
    (means, center, shown), (values, firsts, seconds) = seen, rows
    n, k = shown.shape[0], rates.shape[0] // 3
    bad = 0
    for part in numba.prange((n + _PART - 1) // _PART):
        basis, gradient = np.empty(_MAX_COEFFICIENTS, np.float32), np.empty(3 * _MAX_COEFFICIENTS, np.float32)
        counted, corrections = np.int32(0), (np.float32(1), np.float32(1))
        for i in range(part * _PART, min(n, (part + 1) * _PART)):
            g = shown[i]
            _basis_towards(means[g], center, k, basis)
            for j in range(k):
                for c in range(3):
                    gradient[3 * j + c] = basis[j] * colors[g, c]
            steps[g] += 1
            if steps[g] != counted:
                counted = steps[g]
                corrections = adam.bias_corrections(counted)
            bad += adam.update_row(values[g], gradient, (firsts[g], seconds[g]), corrections, rates)
    return bad
