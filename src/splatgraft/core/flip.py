"""LDR-FLIP (Andersson et al. 2020): the visible difference of two images that alternate on a screen.

Colours are compared after the blur of the eye's contrast sensitivity, edges and points before it. Equation and section
numbers are those of the paper. Every report of `evaluate` with a ground truth has FLIP. The authors' package
flip-evaluator gives the same values (a test compares them), but has no wheels for Linux on ARM and Python 3.14.
"""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.images import linear_from_srgb

_PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180
"""The observer's resolution, 67.02: a 4K screen 0.7 m wide at a distance of 0.7 m (Sec. 5)."""
_SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
"""Contrast sensitivity of the achromatic, red-green and blue-yellow channel, as sums of Gaussians (a, b):
a sqrt(pi / b) exp(-pi^2 x^2 / b), x in degrees (Table 1)."""
_COLOR_EXPONENT = 0.7  # q_c, compresses large colour differences (Sec. 4.1.4).
VERSION = "LDR-FLIP 2020, own implementation, 67.02 pixels per degree"
"""Implementation and viewing conditions, recorded beside each value."""

_XYZ_FROM_LINEAR = torch.tensor(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ],
    dtype=torch.float64,
)
"""sRGB primaries with the white point D65, as the publication's reference has them."""
_WHITE = _XYZ_FROM_LINEAR.sum(1)
_OPPONENT = torch.tensor([[0.0, 116, 0], [500, -500, 0], [0, 200, -200]], dtype=torch.float64)
"""Matrix from XYZ over white to Y Cx Cz, and from their cube roots to L* a* b*."""
_OFFSET = torch.tensor([-16.0, 0, 0], dtype=torch.float64)  # added to the three


def flip_map(image: Float[Tensor, "h w 3"], reference: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """Compute the visible difference of each pixel of two sRGB images; in [0, 1], symmetric in the two."""
    both = [_opponent(linear_from_srgb(x.double().clamp(0, 1))) for x in (image, reference)]
    seen = [_hunt(_lab(_as_seen(x))) for x in both]
    color = _spread(_hyab(seen[0], seen[1]) ** _COLOR_EXPONENT)
    found = [_features((x[..., 0] + 16) / 116) for x in both]
    feature = torch.maximum(*((a - b).abs() for a, b in zip(*found, strict=True)))
    feature = (feature / math.sqrt(2)) ** 0.5  # q_f (Sec. 4.2.2)
    return (color ** (1 - feature)).to(image)


def flip(
    image: Float[Tensor, "h w 3"], reference: Float[Tensor, "h w 3"], region: Bool[Tensor, "h w"] | None = None
) -> Float[Tensor, ""]:
    """Average the visible difference over all pixels, or over a region; nan if that is empty."""
    errors = flip_map(image, reference)
    return errors.mean() if region is None else errors[region].mean()


def _opponent(linear: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Convert to Y Cx Cz, a linear space whose channels have known contrast sensitivities."""
    return (linear @ _XYZ_FROM_LINEAR.T.to(linear) / _WHITE.to(linear)) @ _OPPONENT.T.to(linear) + _OFFSET.to(linear)


def _as_seen(opponent: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Blur Y Cx Cz by the eye's contrast sensitivity; returns linear RGB, clamped to the screen's range."""
    blurred = torch.stack([_blur(opponent[..., i], channel) for i, channel in enumerate(_SENSITIVITY)], -1)
    inverse = torch.linalg.inv(_OPPONENT).to(blurred)
    xyz = (blurred - _OFFSET.to(blurred)) @ inverse.T * _WHITE.to(blurred)
    return (xyz @ torch.linalg.inv(_XYZ_FROM_LINEAR).T.to(blurred)).clamp(0, 1)


def _blur(values: Float[Tensor, "h w"], gaussians: tuple[tuple[float, float], ...]) -> Float[Tensor, "h w"]:
    """Blur by a sum of Gaussians, each applied along rows and columns."""
    widest = max(b for channel in _SENSITIVITY for _, b in channel)
    radius = math.ceil(3 * math.sqrt(widest / (2 * math.pi**2)) * _PIXELS_PER_DEGREE)
    x = torch.arange(-radius, radius + 1, dtype=values.dtype, device=values.device) / _PIXELS_PER_DEGREE
    rows = [(a * math.sqrt(math.pi / b), torch.exp(-(math.pi**2) * x**2 / b)) for a, b in gaussians]
    total = sum(weight * float(row.sum()) ** 2 for weight, row in rows)
    return torch.stack([weight / total * _separable(values, row, row) for weight, row in rows]).sum(0)


def _separable(
    values: Float[Tensor, "h w"], across: Float[Tensor, " k"], down: Float[Tensor, " k"]
) -> Float[Tensor, "h w"]:
    """Correlate with the product of a row and a column; border pixels are repeated outside."""
    radius = len(across) // 2
    padded = F.pad(values[None, None], (radius, radius, radius, radius), mode="replicate")
    return F.conv2d(F.conv2d(padded, across[None, None, None]), down[None, None, :, None])[0, 0]


def _lab(linear: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Convert to CIE L* a* b*."""
    ratio = linear @ _XYZ_FROM_LINEAR.T.to(linear) / _WHITE.to(linear)
    knee = 6 / 29
    root = torch.where(ratio > knee**3, ratio.clamp_min(knee**3) ** (1 / 3), ratio / (3 * knee**2) + 4 / 29)
    return root @ _OPPONENT.T.to(root) + _OFFSET.to(root)


def _hunt(lab: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Scale chroma by lightness: colours differ less in the dark (Hunt effect)."""
    return torch.cat([lab[..., :1], 0.01 * lab[..., :1] * lab[..., 1:]], -1)


def _hyab(a: Float[Tensor, "*n 3"], b: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """Compute the HyAB distance: city block in lightness, Euclidean in chroma (Abasi et al. 2020)."""
    return (a - b)[..., 0].abs() + (a - b)[..., 1:].norm(dim=-1)


def _spread(powered: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Map colour differences to [0, 1]; the largest is between green and blue."""
    primaries = _hunt(_lab(torch.eye(3, dtype=powered.dtype, device=powered.device)[None, 1:]))[0]
    largest = float(_hyab(primaries[0], primaries[1])) ** _COLOR_EXPONENT
    part, top = 0.4, 0.95  # p_c and p_t: differences up to p_c of the largest are spread over [0, p_t] (Sec. 4.1.4)
    knee = part * largest
    above = top + (powered - knee) / (largest - knee) * (1 - top)
    return torch.where(powered < knee, powered * top / knee, above)


def _features(luminance: Float[Tensor, "h w"]) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Compute the strength of edges and of points, by first and second derivatives of a Gaussian."""
    deviation = 0.5 * 0.082 * _PIXELS_PER_DEGREE  # w, degrees from peak to trough of the edge detector (Sec. 4.2.1)
    radius = math.ceil(3 * deviation)
    x = torch.arange(-radius, radius + 1, dtype=luminance.dtype, device=luminance.device)
    gaussian = torch.exp(-(x**2) / (2 * deviation**2))
    # the weights of each sign sum to one over the whole kernel; the column of Gaussian weights sums to one here
    smooth = gaussian / gaussian.sum()
    edge, point = (_signed_unit(kernel) for kernel in (-x * gaussian, (x**2 / deviation**2 - 1) * gaussian))
    strengths = [
        torch.hypot(_separable(luminance, kernel, smooth), _separable(luminance, smooth, kernel))
        for kernel in (edge, point)
    ]
    return strengths[0], strengths[1]


def _signed_unit(kernel: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    negative, positive = -kernel.clamp_max(0).sum(), kernel.clamp_min(0).sum()
    return torch.where(kernel < 0, kernel / negative, kernel / positive)
