"""Projection of Gaussians to 2D splats of one camera, their colours, and the gradients of both: numba kernels.

The projection is EWA splatting as in 3DGS (Eq. 5): covariance J W S W^T J^T plus the low pass, with J taken at a point
clamped to 1.3 times the field of view. All arithmetic on one Gaussian is float64, all storage float32.
"""

import math
from typing import no_type_check

import numpy as np
from numba import float32, prange

from splatgraft.rendering.cpu_basis import basis_and_slope, basis_at
from splatgraft.runtime.kernels import kernel

MIN_ALPHA = 1.0 / 255.0
WIDEST = 2.001 * math.log(1 / MIN_ALPHA)  # square of the half width of an opaque splat over its variance, rounded up
BLOCK = 256
ZERO, HALF = float32(0), float32(0.5)

# columns of a splat: centre (pixels), conic, log opacity, half width and half height (pixels)
MX, MY, CA, CB, CC, LOG_OPACITY, REACH_X, REACH_Y = range(8)
COLUMNS = 8
# columns of a splat's inverse depth: value at the centre, slopes per pixel
AT_CENTER, SLOPE_X, SLOPE_Y = range(3)
DEPTH_COLUMNS = 3

# indices in a camera vector, after rotation (9) and translation (3) of camera_from_world and the centre (3)
FX, FY, CX, CY, LOW_X, HIGH_X, LOW_Y, HIGH_Y, NEAR, WIDTH, HEIGHT, LOW_PASS = range(15, 27)


@kernel
@no_type_check
def _rotation(quaternion, out):
    """Fill the 3x3 matrix of a wxyz quaternion; length 0 gives the identity. Returns one over the length."""
    w, x, y, z = float(quaternion[0]), float(quaternion[1]), float(quaternion[2]), float(quaternion[3])
    inverse = 1.0 / max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return inverse


@kernel
@no_type_check
def _view_axes(log_scales, rotation, camera, out):
    """Fill V = W R S, the Gaussian's scaled axes in the camera, as columns."""
    for j in range(3):
        s = math.exp(float(log_scales[j]))
        for i in range(3):
            c = camera[3 * i] * rotation[0, j] + camera[3 * i + 1] * rotation[1, j] + camera[3 * i + 2] * rotation[2, j]
            out[i, j] = s * c


@kernel
@no_type_check
def _normal_axis(log_scales, rotation, offset):
    """Find the index of the shortest axis and the sign that turns it to the camera; `offset` is centre minus camera."""
    axis = 0
    for j in range(1, 3):
        if log_scales[j] < log_scales[axis]:
            axis = j
    along = rotation[0, axis] * offset[0] + rotation[1, axis] * offset[1] + rotation[2, axis] * offset[2]
    return axis, -1.0 if along > 0 else 1.0


@kernel
@no_type_check
def _camera_point(mean, camera, offset):
    x, y, z = float(mean[0]), float(mean[1]), float(mean[2])
    for i in range(3):
        offset[i] = float(mean[i]) - camera[12 + i]
    return (
        camera[0] * x + camera[1] * y + camera[2] * z + camera[9],
        camera[3] * x + camera[4] * y + camera[5] * z + camera[10],
        camera[6] * x + camera[7] * y + camera[8] * z + camera[11],
    )


@kernel
@no_type_check
def _jacobian(x, y, z, camera):
    """Compute the non-zero entries J00, J02, J11, J12, and whether the point is within the clamping bounds in x, y."""
    u, v = x / z, y / z
    held_u = min(max(u, camera[LOW_X]), camera[HIGH_X])
    held_v = min(max(v, camera[LOW_Y]), camera[HIGH_Y])
    fx, fy = camera[FX] / z, camera[FY] / z
    return fx, -fx * held_u, fy, -fy * held_v, held_u == u, held_v == v


@kernel(parallel=True)
@no_type_check
def project(means, log_scales, quaternions, opacity_logits, camera, antialiased, splats, depths, inverse_depths):
    """Fill `splats (n, 8)` and `depths (n,)`; a splat outside the image or too transparent has log opacity -inf.

    Fill `inverse_depths (n, 3)` unless it is empty: the mean of the Gaussian's 1 / z given the pixel. It is linear in
    the pixel, as 1 / z of a plane is (compare RaDe-GS, Zhang et al. 2024).
    """
    n, low = means.shape[0], camera[LOW_PASS]
    for block in prange((n + BLOCK - 1) // BLOCK):
        rotation, axes, offset = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
        for g in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            splats[g, LOG_OPACITY] = -np.inf
            x, y, z = _camera_point(means[g], camera, offset)
            if not (z >= camera[NEAR] and z < 1e30):
                continue
            j00, j02, j11, j12, _, _ = _jacobian(x, y, z, camera)
            mx, my = camera[FX] * x / z + camera[CX], camera[FY] * y / z + camera[CY]
            # most Gaussians outside the image are so even as opaque balls as wide as their longest axis
            widest = math.exp(2 * float(max(log_scales[g, 0], log_scales[g, 1], log_scales[g, 2])))
            out_x, out_y = max(-mx, mx - camera[WIDTH], 0.0), max(-my, my - camera[HEIGHT], 0.0)
            if out_x * out_x > WIDEST * (widest * (j00 * j00 + j02 * j02) + low):
                continue
            if out_y * out_y > WIDEST * (widest * (j11 * j11 + j12 * j12) + low):
                continue
            opacity = 1.0 / (1.0 + math.exp(-float(opacity_logits[g])))
            if not opacity >= MIN_ALPHA:
                continue
            _rotation(quaternions[g], rotation)
            _view_axes(log_scales[g], rotation, camera, axes)
            xx, xy, yy = 0.0, 0.0, 0.0
            for j in range(3):
                h0, h1 = j00 * axes[0, j] + j02 * axes[2, j], j11 * axes[1, j] + j12 * axes[2, j]
                xx, xy, yy = xx + h0 * h0, xy + h0 * h1, yy + h1 * h1
            sharp = max(xx * yy - xy * xy, 0.0)
            determinant = sharp + low * (xx + yy) + low * low
            if antialiased:
                opacity *= math.sqrt(sharp / determinant)
            # also false where anything is nan or infinite
            if not (opacity >= MIN_ALPHA and determinant < 1e30):
                continue
            limit = 2 * math.log(opacity / MIN_ALPHA)
            reach_x, reach_y = math.sqrt(limit * (xx + low)), math.sqrt(limit * (yy + low))
            if not (-reach_x < mx < camera[WIDTH] + reach_x and -reach_y < my < camera[HEIGHT] + reach_y):
                continue
            splats[g, MX], splats[g, MY] = mx, my
            splats[g, CA] = (yy + low) / determinant
            splats[g, CB] = -xy / determinant
            splats[g, CC] = (xx + low) / determinant
            splats[g, LOG_OPACITY] = math.log(opacity)
            splats[g, REACH_X] = reach_x
            splats[g, REACH_Y] = reach_y
            depths[g] = z
            if inverse_depths.shape[0] > 0:
                cross_x, cross_y = 0.0, 0.0
                for j in range(3):
                    h0, h1 = j00 * axes[0, j] + j02 * axes[2, j], j11 * axes[1, j] + j12 * axes[2, j]
                    k = -axes[2, j] / (z * z)
                    cross_x, cross_y = cross_x + k * h0, cross_y + k * h1
                inverse_depths[g, AT_CENTER] = 1 / z
                inverse_depths[g, SLOPE_X] = ((yy + low) * cross_x - xy * cross_y) / determinant
                inverse_depths[g, SLOPE_Y] = ((xx + low) * cross_y - xy * cross_x) / determinant


@kernel(parallel=True)
@no_type_check
def shade(means, sh, drawn, camera, colors):
    """Fill `colors (n, 3)` with the colours towards the camera where `drawn (n,)`."""
    n, k = sh.shape[0], sh.shape[1]
    for block in prange((n + BLOCK - 1) // BLOCK):
        basis = np.empty(16, np.float32)
        for g in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not drawn[g]:
                continue
            x, y, z = means[g, 0] - camera[12], means[g, 1] - camera[13], means[g, 2] - camera[14]
            inverse = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
            basis_at(x * inverse, y * inverse, z * inverse, k, basis)
            for c in range(3):
                value = HALF
                for j in range(k):
                    value += basis[j] * sh[g, j, c]
                colors[g, c] = max(value, ZERO)


@kernel
@no_type_check
def normals(means, log_scales, quaternions, drawn, camera, out):
    """Fill `out (n, 3)` with world-frame normals towards the camera where `drawn (n,)`."""
    rotation, offset = np.empty((3, 3)), np.empty(3)
    for g in range(drawn.shape[0]):
        if not drawn[g]:
            continue
        _camera_point(means[g], camera, offset)
        _rotation(quaternions[g], rotation)
        axis, sign = _normal_axis(log_scales[g], rotation, offset)
        for i in range(3):
            out[g, i] = sign * rotation[i, axis]


@kernel(parallel=True)
@no_type_check
def shade_backward(means, sh, drawn, camera, totals, at, grad_means, grad_sh):
    """Add the gradients of `shade` to `grad_means` and `grad_sh`; those of colours begin at column `at` of `totals`."""
    n, k = sh.shape[0], sh.shape[1]
    for block in prange((n + BLOCK - 1) // BLOCK):
        basis, slope, along = np.empty(16, np.float32), np.empty((16, 3), np.float32), np.empty(16, np.float32)
        for g in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not drawn[g]:
                continue
            x, y, z = means[g, 0] - camera[12], means[g, 1] - camera[13], means[g, 2] - camera[14]
            inverse = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
            x, y, z = x * inverse, y * inverse, z * inverse
            basis_and_slope(x, y, z, k, basis, slope)
            along[:k] = ZERO
            for c in range(3):
                grad, value = totals[g, at + c], HALF
                for j in range(k):
                    value += basis[j] * sh[g, j, c]
                if value < 0:
                    continue
                for j in range(k):
                    grad_sh[g, j, c] += basis[j] * grad
                    along[j] += sh[g, j, c] * grad
            dx, dy, dz = ZERO, ZERO, ZERO
            for j in range(1, k):
                dx += slope[j, 0] * along[j]
                dy += slope[j, 1] * along[j]
                dz += slope[j, 2] * along[j]
            radial = dx * x + dy * y + dz * z
            grad_means[g, 0] += (dx - radial * x) * inverse
            grad_means[g, 1] += (dy - radial * y) * inverse
            grad_means[g, 2] += (dz - radial * z) * inverse


@kernel
@no_type_check
def _add_quaternion_gradient(quaternion, inverse, d, out):
    """Add the gradient by the raw wxyz quaternion, given the gradient `d` (3x3) by its rotation matrix."""
    w, x, y, z = quaternion[0] * inverse, quaternion[1] * inverse, quaternion[2] * inverse, quaternion[3] * inverse
    gw = 2 * (x * (d[2, 1] - d[1, 2]) + y * (d[0, 2] - d[2, 0]) + z * (d[1, 0] - d[0, 1]))
    gx = 2 * (y * (d[0, 1] + d[1, 0]) + z * (d[0, 2] + d[2, 0]) + w * (d[2, 1] - d[1, 2]) - 2 * x * (d[1, 1] + d[2, 2]))
    gy = 2 * (x * (d[0, 1] + d[1, 0]) + z * (d[1, 2] + d[2, 1]) + w * (d[0, 2] - d[2, 0]) - 2 * y * (d[0, 0] + d[2, 2]))
    gz = 2 * (x * (d[0, 2] + d[2, 0]) + y * (d[1, 2] + d[2, 1]) + w * (d[1, 0] - d[0, 1]) - 2 * z * (d[0, 0] + d[1, 1]))
    along = gw * w + gx * x + gy * y + gz * z
    out[0] += (gw - along * w) * inverse
    out[1] += (gx - along * x) * inverse
    out[2] += (gy - along * y) * inverse
    out[3] += (gz - along * z) * inverse


@kernel(parallel=True)
@no_type_check
def project_backward(
    means, log_scales, quaternions, opacity_logits, drawn, camera, antialiased, totals, depth_at, normal_at,
    grad_means, grad_log_scales, grad_quaternions, grad_opacity_logits,
):  # fmt: skip
    """Add the gradients of `project` to the gradients of the raw fields, given those of the splats.

    `totals (n, ..)` begins with sums over pixels of dL/d(exponent) times 1, dx, dy, dx^2, dx dy, dy^2, where d goes
    from the centre to the pixel. The gradients of the three columns of inverse depth begin at column `depth_at`, those
    of the normal at `normal_at`; 0 means that they are missing.
    """
    n, low = means.shape[0], camera[LOW_PASS]
    for block in prange((n + BLOCK - 1) // BLOCK):
        rotation, axes, offset = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
        d_axes, d_rotation = np.empty((3, 3)), np.empty((3, 3))
        for g in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not drawn[g]:
                continue
            x, y, z = _camera_point(means[g], camera, offset)
            inverse = _rotation(quaternions[g], rotation)
            _view_axes(log_scales[g], rotation, camera, axes)
            j00, j02, j11, j12, free_x, free_y = _jacobian(x, y, z, camera)
            xx, xy, yy = 0.0, 0.0, 0.0
            for j in range(3):
                h0, h1 = j00 * axes[0, j] + j02 * axes[2, j], j11 * axes[1, j] + j12 * axes[2, j]
                xx, xy, yy = xx + h0 * h0, xy + h0 * h1, yy + h1 * h1
            sharp = max(xx * yy - xy * xy, 0.0)
            determinant = sharp + low * (xx + yy) + low * low
            a, b, c = (yy + low) / determinant, -xy / determinant, (xx + low) / determinant

            s0, sx, sy = float(totals[g, 0]), float(totals[g, 1]), float(totals[g, 2])
            sxx, sxy, syy = float(totals[g, 3]), float(totals[g, 4]), float(totals[g, 5])
            opacity = 1.0 / (1.0 + math.exp(-float(opacity_logits[g])))
            grad_opacity_logits[g] += s0 * (1 - opacity)
            d_mx, d_my = a * sx + b * sy, b * sx + c * sy
            # d covariance = Q S Q / 2, with Q the inverse covariance and S the second moments
            p00, p01, p10, p11 = a * sxx + b * sxy, a * sxy + b * syy, b * sxx + c * sxy, b * sxy + c * syy
            d_xx = 0.5 * (p00 * a + p01 * b)
            d_xy = p00 * b + p01 * c
            d_yy = 0.5 * (p10 * b + p11 * c)
            if antialiased:
                to_sharp, to_blurred = 0.5 * s0 / sharp, -0.5 * s0 / determinant
                d_xx += to_sharp * yy + to_blurred * (yy + low)
                d_yy += to_sharp * xx + to_blurred * (xx + low)
                d_xy -= 2 * xy * (to_sharp + to_blurred)

            # gradients by the covariances of 1 / z with the pixel
            d_cross_x, d_cross_y, d_inverse_depth = 0.0, 0.0, 0.0
            if depth_at > 0 and free_x and free_y:
                cross_x, cross_y = 0.0, 0.0
                for j in range(3):
                    h0, h1 = j00 * axes[0, j] + j02 * axes[2, j], j11 * axes[1, j] + j12 * axes[2, j]
                    k = -axes[2, j] / (z * z)
                    cross_x, cross_y = cross_x + k * h0, cross_y + k * h1
                slope_x, slope_y = a * cross_x + b * cross_y, b * cross_x + c * cross_y
                d_inverse_depth = float(totals[g, depth_at + AT_CENTER])
                d_slope_x, d_slope_y = float(totals[g, depth_at + SLOPE_X]), float(totals[g, depth_at + SLOPE_Y])
                d_mx, d_my = d_mx - slope_x * d_inverse_depth, d_my - slope_y * d_inverse_depth
                d_cross_x, d_cross_y = a * d_slope_x + b * d_slope_y, b * d_slope_x + c * d_slope_y
                d_xx -= d_cross_x * slope_x
                d_yy -= d_cross_y * slope_y
                d_xy -= d_cross_x * slope_y + d_cross_y * slope_x

            d00, d02, d11, d12, d_z = 0.0, 0.0, 0.0, 0.0, -d_inverse_depth / (z * z)
            for j in range(3):
                h0, h1 = j00 * axes[0, j] + j02 * axes[2, j], j11 * axes[1, j] + j12 * axes[2, j]
                k = -axes[2, j] / (z * z)
                d_h0 = 2 * d_xx * h0 + d_xy * h1 + d_cross_x * k
                d_h1 = 2 * d_yy * h1 + d_xy * h0 + d_cross_y * k
                d_k = d_cross_x * h0 + d_cross_y * h1
                d00, d02 = d00 + d_h0 * axes[0, j], d02 + d_h0 * axes[2, j]
                d11, d12 = d11 + d_h1 * axes[1, j], d12 + d_h1 * axes[2, j]
                d_axes[0, j], d_axes[1, j] = j00 * d_h0, j11 * d_h1
                d_axes[2, j] = j02 * d_h0 + j12 * d_h1 - d_k / (z * z)
                d_z -= 2 * d_k * k / z

            dx, dy = camera[FX] / z * d_mx, camera[FY] / z * d_my
            dz = d_z - (dx * x + dy * y) / z - (d00 * j00 + d02 * j02 + d11 * j11 + d12 * j12) / z
            if free_x:
                d_u = -j00 * d02
                dx, dz = dx + d_u / z, dz - d_u * x / (z * z)
            if free_y:
                d_v = -j11 * d12
                dy, dz = dy + d_v / z, dz - d_v * y / (z * z)
            for i in range(3):
                grad_means[g, i] += camera[i] * dx + camera[3 + i] * dy + camera[6 + i] * dz

            for j in range(3):
                scale = math.exp(float(log_scales[g, j]))
                total = 0.0
                for i in range(3):
                    d = camera[i] * d_axes[0, j] + camera[3 + i] * d_axes[1, j] + camera[6 + i] * d_axes[2, j]
                    total += d * rotation[i, j]
                    d_rotation[i, j] = d * scale
                grad_log_scales[g, j] += total * scale
            if normal_at > 0:
                axis, sign = _normal_axis(log_scales[g], rotation, offset)
                for i in range(3):
                    d_rotation[i, axis] += sign * totals[g, normal_at + i]
            _add_quaternion_gradient(quaternions[g], inverse, d_rotation, grad_quaternions[g])
