"""Sparse Adam: updates only the Gaussians in the current view (Mallick et al. 2024, Taming 3DGS, Sec. 4.4).

Each Gaussian counts its own steps, so the bias correction (Kingma & Ba 2015, Alg. 1) is right for Gaussians that are
rarely seen or were added later. The CPU version is one fused numba kernel.
"""

from dataclasses import dataclass, replace
from typing import no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.runtime.kernels import FAST_MATH, kernel, serialized

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-15
_PART = 1024  # Gaussians per task of a thread


@dataclass(frozen=True)
class Moments:
    """Adam's moments by field, each of its field's shape."""

    first: dict[str, Tensor]
    """Running mean of the gradient."""
    second: dict[str, Tensor]
    """Running mean of the squared gradient."""
    steps: Int[Tensor, "n"]
    """Number of updates of each Gaussian, int32."""

    def select(self, which: Int[Tensor, "m"] | Bool[Tensor, "n"]) -> "Moments":
        """Return the moments of the chosen Gaussians."""
        return Moments(
            {k: v[which] for k, v in self.first.items()},
            {k: v[which] for k, v in self.second.items()},
            self.steps[which],
        )

    def reset(self, which: Int[Tensor, "m"]) -> "Moments":
        """Return a copy with the moments and steps of the chosen Gaussians set to zero."""
        out = Moments(
            {k: v.clone() for k, v in self.first.items()},
            {k: v.clone() for k, v in self.second.items()},
            self.steps.clone(),
        )
        for tensor in (*out.first.values(), *out.second.values(), out.steps):
            tensor[which] = 0
        return out

    def padded(self, field: str, columns: int) -> "Moments":
        """Return a copy with the second axis of one field's moments padded with zeros to `columns`."""

        def grow(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
            old = tensors[field]
            new = old.new_zeros(old.shape[0], columns, *old.shape[2:])
            new[:, : old.shape[1]] = old
            return tensors | {field: new}

        return replace(self, first=grow(self.first), second=grow(self.second))


def no_moments(tensors: dict[str, Tensor], count: int) -> Moments:
    """Return zero moments for tensors of `count` Gaussians."""
    device = next(iter(tensors.values())).device
    return Moments(
        {k: torch.zeros_like(v) for k, v in tensors.items()},
        {k: torch.zeros_like(v) for k, v in tensors.items()},
        torch.zeros(count, dtype=torch.int32, device=device),
    )


def step(
    values: dict[str, Tensor],
    gradients: dict[str, Tensor],
    *,
    moments: Moments,
    rates: dict[str, Float[Tensor, "c"]],
    visible: Bool[Tensor, "n"],
) -> bool:
    """Update the visible Gaussians' values and moments in place.

    Args:
        values: Values (n, ..) by field.
        gradients: Gradients of the loss by field.
        moments: Moments of the same fields.
        rates: Learning rate of each flattened column, by field.
        visible: Which Gaussians are updated.

    Returns:
        Whether all gradients were finite; rows with other gradients stay unchanged.
    """
    moments.steps[visible] += 1
    update = _step_numba if visible.device.type == "cpu" else _step_torch
    n = len(visible)
    names = tuple(values)
    rows = tuple(
        tuple(tensors[name].reshape(n, -1).contiguous() for name in names)
        for tensors in (values, gradients, moments.first, moments.second)
    )
    return update(rows, moments.steps, tuple(rates[name] for name in names), visible)


_Fields = tuple[Float[Tensor, "n _"], ...]
_Rates = tuple[Float[Tensor, "_"], ...]
_Rows = tuple[_Fields, ...]  # values, gradients, first and second moments, each of all fields


def _step_numba(rows: _Rows, steps: Int[Tensor, "n"], rates: _Rates, visible: Bool[Tensor, "n"]) -> bool:
    if len(visible) == 0:
        return True
    values, gradients, firsts, seconds = (tuple(tensor.numpy() for tensor in fields) for fields in rows)
    numbers = tuple(rate.numpy() for rate in rates)
    return _update_rows(values, gradients, (firsts, seconds), (steps.numpy(), visible.numpy()), numbers) == 0


@kernel(fastmath=FAST_MATH, error_model="numpy")
@no_type_check
def bias_corrections(step):
    """Compute the factors on the first and second moment after update number `step`, counted from 1."""
    one = np.float32(1)
    return (
        one / (one - np.float32(BETA_1) ** np.float32(step)),
        one / (one - np.float32(BETA_2) ** np.float32(step)),
    )


# divisions follow numpy, because a check for zero would be a branch in the loop
@kernel(fastmath=FAST_MATH, error_model="numpy")
@no_type_check
def update_row(value, gradient, moments, corrections, rate):
    """Update one Gaussian's row of a field in place; return 1 and change nothing if a gradient is not finite."""
    (first, second), (correct_1, correct_2) = moments, corrections
    one, b1, b2 = np.float32(1), np.float32(BETA_1), np.float32(BETA_2)
    columns = value.shape[0]
    bad = 0
    for j in range(columns):
        if not abs(gradient[j]) < np.float32(1e18):  # its square would leave float32; also catches nan
            bad = 1
    if bad == 0:
        for j in range(columns):
            g = gradient[j]
            m = b1 * first[j] + (one - b1) * g
            v = b2 * second[j] + (one - b2) * g * g
            first[j] = m
            second[j] = v
            value[j] -= rate[j] * m * correct_1 / (np.sqrt(v * correct_2) + np.float32(EPSILON))
    return bad


@kernel
@no_type_check
def _update_part(value, gradient, moments, part, rate):
    """Update the rows of `part` = (first, last, steps, visible); return the number of rows without finite gradients."""
    first, second = moments
    begin, end, steps, visible = part
    bad, counted, corrections = 0, np.int32(0), (np.float32(1), np.float32(1))
    for i in range(begin, end):
        if not visible[i]:
            continue
        if steps[i] != counted:
            counted = steps[i]
            corrections = bias_corrections(counted)
        bad += update_row(value[i], gradient[i], (first[i], second[i]), corrections, rate)
    return bad


@serialized
@kernel(parallel=True)
@no_type_check
def _update_rows(values, gradients, moments, counts, rates):
    """Update all fields in one launch; `counts` = (steps, visible)."""
    firsts, seconds = moments
    steps, visible = counts
    n = len(visible)
    bad = 0
    for part in numba.prange((n + _PART - 1) // _PART):
        rows = (part * _PART, min(n, (part + 1) * _PART), steps, visible)
        for f in range(len(values)):
            bad += _update_part(values[f], gradients[f], (firsts[f], seconds[f]), rows, rates[f])
    return bad


def _step_torch(rows: _Rows, steps: Int[Tensor, "n"], rates: _Rates, visible: Bool[Tensor, "n"]) -> bool:
    """Do the same update in torch operations, on any device."""
    finite = True
    seen = torch.nonzero(visible).flatten()
    for value, gradient, first, second, rate in zip(*rows, rates, strict=True):
        good = (gradient[seen].abs() < 1e18).all(1)
        which = seen[good]
        g = gradient[which]
        m = BETA_1 * first[which] + (1 - BETA_1) * g
        v = BETA_2 * second[which] + (1 - BETA_2) * g * g
        first[which], second[which] = m, v
        count = steps[which].to(g.dtype)[:, None]
        scale = (v / (1 - BETA_2**count)).sqrt() + EPSILON
        value[which] -= rate.to(g) * (m / (1 - BETA_1**count)) / scale
        finite &= bool(good.all())
    return finite
