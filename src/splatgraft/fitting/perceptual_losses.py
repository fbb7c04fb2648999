"""Perceptual losses between two images: L1 of windowed Fourier magnitudes, and LPIPS with VGG-16 (Zhang 2018).

Every loss takes an image and a target, sRGB in [0, 1], and returns a scalar that is 0 if they are equal. Only the image
receives a gradient. LPIPS reads its weights from the disk; nothing is downloaded.
"""

import hashlib
import math
import pickle
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.fitting import fourier_windows

VGG_FILE = "vgg16-397923af.pth"
HEADS_FILE = "vgg.pth"
# index of each 3x3 convolution in torchvision's vgg16().features, one row per resolution
_VGG_LAYERS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
_VGG_CHANNELS = (64, 128, 256, 512, 512)
_WINDOW_PX = fourier_windows.SIZE
_L1_SHARE = 0.1  # weight of L1 between pixels beside the Fourier magnitudes

ImageLoss = Callable[[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]], Float[Tensor, ""]]
"""A distance from the first image to the second, differentiable in the first."""


def l1(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Compute the mean absolute difference."""
    return (image - target).abs().mean()


def windowed_fourier(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Compute L1 between the Fourier magnitudes of overlapping Hann windows, plus a tenth of L1 between the pixels.

    Windows have 16 pixels and overlap by half. Magnitudes do not depend on the position of an edge in the window. So
    one sharp edge has a smaller loss than the average of two if views disagree by a pixel. Magnitudes are scaled so
    that independent noise has the same standard deviation in magnitudes and pixels.
    """
    window = _hann(image.dtype, image.device)
    planes, wanted_planes = _padded(image), _padded(target.detach())
    if image.device.type == "cpu" and image.dtype == torch.float32:
        spectral = fourier_windows.spectral_distance(planes, wanted_planes, window)
    else:
        # share of the full spectrum in each column of a half spectrum
        shares = window.new_full((_WINDOW_PX // 2 + 1,), 2 / _WINDOW_PX)
        shares[0] = shares[-1] = 1 / _WINDOW_PX
        difference = _magnitudes(planes, window) - _magnitudes(wanted_planes, window)
        spectral = (difference.abs().mean((0, 1, 2, 3)) * shares).sum()
    return spectral + _L1_SHARE * l1(image, target.detach())


@lru_cache(maxsize=8)
def _hann(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "size size"]:
    """Return the Hann window with a mean square of 1."""
    ramp = torch.hann_window(_WINDOW_PX, dtype=dtype, device=device)
    window = ramp[:, None] * ramp[None, :]
    return window / (window**2).mean().sqrt()


def _padded(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "3 y x"]:
    """Return planes with a repeated border, so that windows cover every pixel twice in each direction."""
    hop = _WINDOW_PX // 2
    pads = [(hop, hop + (-length) % hop) for length in image.shape[1::-1]]
    return F.pad(image.permute(2, 0, 1)[None], [*pads[0], *pads[1]], mode="replicate")[0]


def _magnitudes(planes: Float[Tensor, "3 y x"], window: Float[Tensor, "s s"]) -> Float[Tensor, "3 i j s t"]:
    patches = planes.unfold(1, _WINDOW_PX, _WINDOW_PX // 2).unfold(2, _WINDOW_PX, _WINDOW_PX // 2)
    return torch.fft.rfft2(patches * window, norm="ortho").abs()


def lpips_vgg(folder: Path | None = None, *, black: float = -1.0) -> ImageLoss:
    """Load LPIPS (Zhang 2018, version 0.1, VGG-16, linear heads) with weights from `folder`.

    Args:
        folder: Folder of vgg16-397923af.pth from torchvision and of the heads vgg.pth, which is
            lpips/weights/v0.1/vgg.pth in the lpips package; by default torch hub's cache.
        black: Value of 0 in the network's input, where 1 stays 1; -1 as published, 0 as in 3DGS's metrics.py.

    Raises:
        ValueError: A file is missing or is not these weights.
    """
    folder = Path(torch.hub.get_dir()) / "checkpoints" if folder is None else folder
    vgg, heads = _load(folder / VGG_FILE), _load(folder / HEADS_FILE)
    convolutions: list[list[tuple[Tensor, Tensor]]] = []
    below = 3
    for layers, channels in zip(_VGG_LAYERS, _VGG_CHANNELS, strict=True):
        convolutions.append([])
        for layer in layers:
            weight = _take(vgg, f"features.{layer}.weight", (channels, below, 3, 3), folder / VGG_FILE)
            bias = _take(vgg, f"features.{layer}.bias", (channels,), folder / VGG_FILE)
            convolutions[-1].append((weight, bias))
            below = channels
    taps = [
        _take(heads, f"lin{i}.model.1.weight", (1, channels, 1, 1), folder / HEADS_FILE)
        for i, channels in enumerate(_VGG_CHANNELS)
    ]

    @lru_cache(maxsize=2)  # copied to a device once, not at every call
    def placed(device: torch.device, dtype: torch.dtype) -> tuple[list[list[list[Tensor]]], list[Tensor]]:
        layers = [[[one.to(device, dtype) for one in pair] for pair in level] for level in convolutions]
        return layers, [tap.to(device, dtype) for tap in taps]

    def features(image: Float[Tensor, "h w 3"]) -> list[Tensor]:
        """Compute activations (c, h', w') after each resolution's last convolution, normalised over the channels."""
        if min(image.shape[:2]) < 16:
            raise ValueError(f"lpips: expected images of at least 16x16 pixels, found {tuple(image.shape[:2])}")
        # the input scaling of the published weights
        shift, scale = image.new_tensor([-0.030, -0.088, -0.188]), image.new_tensor([0.458, 0.448, 0.450])
        x = (((1 - black) * image + black - shift) / scale).permute(2, 0, 1)[None]
        found = []
        for level, layers in enumerate(placed(x.device, x.dtype)[0]):
            x = F.max_pool2d(x, 2) if level else x
            for weight, bias in layers:
                x = F.relu(F.conv2d(x, weight, bias, padding=1))
            found.append((x / ((x**2).sum(1, keepdim=True) + 1e-20).sqrt())[0])
        return found

    def loss(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
        with torch.no_grad():
            wanted = features(target)
        pairs = zip(features(image), wanted, placed(image.device, image.dtype)[1], strict=True)
        return torch.stack([F.conv2d(((a - b) ** 2)[None], tap).mean() for a, b, tap in pairs]).sum()

    return loss


def is_published(path: Path) -> bool:
    """Test whether a file of weights has the hash at the end of its published name, as torch hub does."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest().startswith(path.stem.rpartition("-")[2])


def _load(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise ValueError(
            f"{path}: expected weights for LPIPS ({VGG_FILE} from torchvision, {HEADS_FILE} from the lpips package, "
            "weights v0.1), found no such file; put both there or name their folder"
        )
    try:
        # the published heads were saved from a GPU
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, KeyError, pickle.UnpicklingError, OSError) as error:
        raise ValueError(f"{path}: expected torch weights, found {type(error).__name__}") from error
    if not isinstance(state, dict):
        raise ValueError(f"{path}: expected a table of weights, found {type(state).__name__}")
    return state


def _take(state: dict[str, Tensor], key: str, shape: tuple[int, ...], path: Path) -> Tensor:
    tensor = state.get(key)
    if not isinstance(tensor, Tensor) or tuple(tensor.shape) != shape:
        found = tuple(tensor.shape) if isinstance(tensor, Tensor) else "nothing"
        raise ValueError(f"{path}: expected {key} of shape {shape}, found {found}")
    if not math.isfinite(float(tensor.sum())):
        raise ValueError(f"{path}: expected finite weights, found {key} with others")
    return tensor.float()
