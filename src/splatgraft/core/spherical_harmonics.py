"""Real spherical harmonics of degree 0 to 3: basis values, colours of Gaussians, rotation of coefficients.

Sign and order follow the 3DGS convention: band l holds m = -l .. l, band 1 is (-y, z, -x) times a constant.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 3
C0 = 0.28209479177387814
"""Value of the band-0 basis function, 1 / (2 sqrt(pi))."""
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def coefficient_count(degree: int) -> int:
    """Return the number of coefficients of all bands up to `degree`."""
    return (degree + 1) ** 2


def degree_of(coefficients: int) -> int:
    """Return the degree of an expansion with `coefficients` coefficients.

    Raises: ValueError if the number is not 1, 4, 9 or 16.
    """
    degree = math.isqrt(coefficients) - 1
    if not 0 <= degree <= MAX_DEGREE or coefficient_count(degree) != coefficients:
        raise ValueError(f"spherical harmonics: expected 1, 4, 9 or 16 coefficients, found {coefficients}")
    return degree


def basis(directions: Float[Tensor, "*n 3"], degree: int) -> Float[Tensor, "*n k"]:
    """Evaluate the basis at unit `directions`; k = (degree + 1)^2."""
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, C0)]
    if degree >= 1:
        values += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        values += [
            _C2[0] * x * y,
            _C2[1] * y * z,
            _C2[2] * (2 * zz - xx - yy),
            _C2[3] * x * z,
            _C2[4] * (xx - yy),
        ]
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        values += [
            _C3[0] * y * (3 * xx - yy),
            _C3[1] * x * y * z,
            _C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            _C3[4] * x * (4 * zz - xx - yy),
            _C3[5] * z * (xx - yy),
            _C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(values, -1)


def band_from_slope(slope: Float[Tensor, "*n 3 c"]) -> Float[Tensor, "*n 3 c"]:
    """Compute coefficients of band 1 whose value along unit d is slope . d; `slope` has the world's axes first."""
    x, y, z = slope.unbind(-2)
    return torch.stack([-y, z, -x], -2) / _C1


def colors(sh: Float[Tensor, "n k 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Evaluate sRGB along unit `directions`, camera to Gaussian: the expansion plus one half, at least 0."""
    values = basis(directions, degree_of(sh.shape[1]))
    return (torch.einsum("nk,nkc->nc", values, sh) + 0.5).clamp_min(0)


def dc_from_rgb(rgb: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
    """Compute the band-0 coefficient of a view-independent colour."""
    return (rgb - 0.5) / C0


def rgb_from_dc(dc: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
    """Compute the mean colour over all directions from the band-0 coefficient `dc`."""
    return dc * C0 + 0.5


def with_degree(sh: Float[Tensor, "n k 3"], degree: int) -> Float[Tensor, "n j 3"]:
    """Cut or zero-pad the expansion to `degree`; j = (degree + 1)^2."""
    count = coefficient_count(degree)
    if count <= sh.shape[1]:
        return sh[:, :count]
    return torch.cat([sh, sh.new_zeros(sh.shape[0], count - sh.shape[1], 3)], 1)


def rotation_matrix(rotation: Float[Tensor, "3 3"], degree: int) -> Float[Tensor, "k k"]:
    """Compute the matrix D of f'(d) = f(R^T d), c' = D c; block-diagonal by band, float64.

    It is solved from the basis at 64 directions of a Fibonacci lattice; exact, because bands are closed under rotation.
    """
    rotation = rotation.detach().to("cpu", torch.float64)
    i = torch.arange(64, dtype=torch.float64)
    z = 1 - (2 * i + 1) / 64
    azimuth = i * (math.pi * (3 - math.sqrt(5)))
    ring = (1 - z * z).sqrt()
    directions = torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), z], -1)
    before, after = basis(directions, degree), basis(directions @ rotation.T, degree)
    out = torch.zeros(coefficient_count(degree), coefficient_count(degree), dtype=torch.float64)
    for band in range(degree + 1):
        part = slice(band * band, (band + 1) ** 2)
        # before(d) . c = after(R d) . D c for every c  =>  D = pinv(after) before
        out[part, part] = torch.linalg.lstsq(after[:, part], before[:, part]).solution
    return out


def rotate(sh: Float[Tensor, "n k 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "n k 3"]:
    """Rotate the expansion, as if the object that emits this radiance were rotated by `rotation`."""
    matrix = rotation_matrix(rotation, degree_of(sh.shape[1])).to(sh)
    return torch.einsum("jk,nkc->njc", matrix, sh)
