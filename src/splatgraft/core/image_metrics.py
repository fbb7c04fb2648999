"""PSNR and SSIM (Wang 2004) of images in [0, 1], whole or in a region, differentiable; and a fit of colours."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


def psnr(
    image: Float[Tensor, "*n c"], reference: Float[Tensor, "*n c"], region: Bool[Tensor, "*n"] | None = None
) -> Float[Tensor, ""]:
    """Compute the peak signal-to-noise ratio, dB, for a peak of 1: infinite for equal images, nan for no pixels."""
    squares = (image - reference) ** 2
    mean = squares.mean() if region is None else squares[region].mean()
    return -10 * mean.log10()


def fit_color(image: Float[Tensor, "h w 3"], reference: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Map the colours of `image` to the reference's by one affine map (least squares), clamped to [0, 1].

    The remaining error is free of exposure and white balance. `color_correct` of Mip-NeRF 360's evaluation has
    quadratic terms besides.
    """
    pixels = image.reshape(-1, 3).double()
    columns = torch.cat([pixels, torch.ones_like(pixels[:, :1])], 1)
    # normal equations with a ridge far below one grey level, for images of one colour
    matrix = columns.T @ columns + 1e-6 * len(columns) * torch.eye(4, dtype=columns.dtype, device=columns.device)
    solution = torch.linalg.solve(matrix, columns.T @ reference.reshape(-1, 3).double())
    return (columns @ solution).to(image).reshape(image.shape).clamp(0, 1)


def _window(channels: int, like: Tensor) -> Float[Tensor, "c 1 11 1"]:
    x = torch.arange(11, device=like.device, dtype=like.dtype) - 5
    weights = torch.exp(-(x**2) / (2 * 1.5**2))
    return (weights / weights.sum()).reshape(1, 1, 11, 1).repeat(channels, 1, 1, 1)


def ssim_map(image: Float[Tensor, "h w c"], reference: Float[Tensor, "h w c"]) -> Float[Tensor, "i j c"]:
    """Compute SSIM per pixel (Wang 2004): 11x11 Gaussian window of sigma 1.5, (h-10, w-10) valid pixels.

    Raises: ValueError if an image is smaller than the window.
    """
    h, w, channels = image.shape
    if min(h, w) < 11:
        raise ValueError(f"ssim: expected images of at least 11x11 pixels, found {w}x{h}")
    x, y = image.permute(2, 0, 1)[None], reference.permute(2, 0, 1)[None]
    stack = torch.cat([x, y, x * x, y * y, x * y], 1)
    window = _window(5 * channels, image)
    blurred = F.conv2d(F.conv2d(stack, window, groups=5 * channels), window.mT, groups=5 * channels)
    mean_x, mean_y, xx, yy, xy = blurred.chunk(5, 1)
    c1, c2 = 0.01**2, 0.03**2
    covariance, variance_x, variance_y = xy - mean_x * mean_y, xx - mean_x**2, yy - mean_y**2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
    return (luminance * structure)[0].permute(1, 2, 0)


def ssim(
    image: Float[Tensor, "h w c"], reference: Float[Tensor, "h w c"], region: Bool[Tensor, "h w"] | None = None
) -> Float[Tensor, ""]:
    """Average structural similarity, over a region by the pixels whose window centre lies in it."""
    values = ssim_map(image, reference)
    return values.mean() if region is None else values[region[5:-5, 5:-5]].mean()
