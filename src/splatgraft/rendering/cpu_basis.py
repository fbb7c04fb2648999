"""Spherical-harmonic basis values and derivatives at one direction, for numba kernels.

`core.spherical_harmonics` has the same functions for torch; a test compares the two.
"""

from typing import no_type_check

from splatgraft.runtime.kernels import kernel

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C20, C22, C24 = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
C30, C31, C32, C33, C35 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


@kernel
@no_type_check
def basis_at(x, y, z, k, out):
    """Fill the first k values of `out (16,)` at the unit direction x, y, z."""
    out[0] = C0
    if k > 1:
        out[1], out[2], out[3] = -C1 * y, C1 * z, -C1 * x
    if k > 4:
        xx, yy, zz = x * x, y * y, z * z
        out[4], out[5] = C20 * x * y, -C20 * y * z
        out[6] = C22 * (2 * zz - xx - yy)
        out[7], out[8] = -C20 * x * z, C24 * (xx - yy)
        if k > 9:
            out[9] = -C30 * y * (3 * xx - yy)
            out[10] = C31 * x * y * z
            out[11] = -C32 * y * (4 * zz - xx - yy)
            out[12] = C33 * z * (2 * zz - 3 * xx - 3 * yy)
            out[13] = -C32 * x * (4 * zz - xx - yy)
            out[14] = C35 * z * (xx - yy)
            out[15] = -C30 * x * (xx - 3 * yy)


@kernel
@no_type_check
def basis_and_slope(x, y, z, k, out, slope):
    """Fill `out` as `basis_at` does, and the first k rows of `slope (16, 3)` with the derivatives in x, y, z."""
    basis_at(x, y, z, k, out)
    slope[0, 0], slope[0, 1], slope[0, 2] = 0.0, 0.0, 0.0
    if k > 1:
        slope[1, 0], slope[1, 1], slope[1, 2] = 0.0, -C1, 0.0
        slope[2, 0], slope[2, 1], slope[2, 2] = 0.0, 0.0, C1
        slope[3, 0], slope[3, 1], slope[3, 2] = -C1, 0.0, 0.0
    if k > 4:
        xx, yy, zz = x * x, y * y, z * z
        slope[4, 0], slope[4, 1], slope[4, 2] = C20 * y, C20 * x, 0.0
        slope[5, 0], slope[5, 1], slope[5, 2] = 0.0, -C20 * z, -C20 * y
        slope[6, 0], slope[6, 1], slope[6, 2] = -2 * C22 * x, -2 * C22 * y, 4 * C22 * z
        slope[7, 0], slope[7, 1], slope[7, 2] = -C20 * z, 0.0, -C20 * x
        slope[8, 0], slope[8, 1], slope[8, 2] = 2 * C24 * x, -2 * C24 * y, 0.0
        if k > 9:
            slope[9, 0], slope[9, 1], slope[9, 2] = -6 * C30 * x * y, -3 * C30 * (xx - yy), 0.0
            slope[10, 0], slope[10, 1], slope[10, 2] = C31 * y * z, C31 * x * z, C31 * x * y
            slope[11, 0], slope[11, 1] = 2 * C32 * x * y, -C32 * (4 * zz - xx - 3 * yy)
            slope[11, 2] = -8 * C32 * y * z
            slope[12, 0], slope[12, 1] = -6 * C33 * x * z, -6 * C33 * y * z
            slope[12, 2] = C33 * (6 * zz - 3 * xx - 3 * yy)
            slope[13, 0], slope[13, 1] = -C32 * (4 * zz - 3 * xx - yy), 2 * C32 * x * y
            slope[13, 2] = -8 * C32 * x * z
            slope[14, 0], slope[14, 1], slope[14, 2] = 2 * C35 * x * z, -2 * C35 * y * z, C35 * (xx - yy)
            slope[15, 0], slope[15, 1], slope[15, 2] = -3 * C30 * (xx - yy), 6 * C30 * x * y, 0.0
