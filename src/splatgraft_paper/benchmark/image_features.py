"""FID and KID between sets of images, from torch-fidelity's Inception features, which the published FID used.

torch-fidelity is no optional dependency of this package, because it needs a torchvision that fits torch. Its weights
are read from a given folder and never downloaded.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

INCEPTION_FILE = "weights-inception-2015-12-05-6726825d.pth"
Features = Callable[[Sequence[Float[Tensor, "h w 3"]]], Float[np.ndarray, "n d"]]
"""Function from images, sRGB in [0, 1], to one row of features per image."""
_KID_SUBSETS, _KID_SIZE = 100, 50  # random subsets of KID, images per subset


def inception_features(folder: Path | None) -> Features:
    """Load the network of the published FID with its 2048 features from `folder`, or from torch hub's cache if None."""
    path = (Path(torch.hub.get_dir()) / "checkpoints" if folder is None else folder) / INCEPTION_FILE
    if not path.is_file():
        raise ValueError(f"{path}: expected Inception weights of torch-fidelity, found no such file")
    try:
        from torch_fidelity.feature_extractor_inceptionv3 import FeatureExtractorInceptionV3
    except (ImportError, RuntimeError) as error:
        raise ValueError(
            "torch_fidelity: expected an installed package (pip install torch-fidelity) with a torchvision that fits "
            f"torch, found {error}"
        ) from error
    network = FeatureExtractorInceptionV3("inception-v3-compat", ["2048"], feature_extractor_weights_path=str(path))

    def features(pictures: Sequence[Float[Tensor, "h w 3"]]) -> Float[np.ndarray, "n d"]:
        rows = []
        for picture in pictures:
            bytes_ = (picture.clamp(0, 1) * 255).round().to(torch.uint8).permute(2, 0, 1)[None]
            rows.append(network(bytes_)[0][0].detach().double().numpy())
        return np.stack(rows)

    return features


def frechet_distance(found: Float[np.ndarray, "n d"], reference: Float[np.ndarray, "m d"]) -> float:
    """Compute FID (Heusel et al. 2017, Eq. 6): the Frechet distance between normal distributions fitted to both sets.

    FID is biased upwards if there are fewer images than features, so compare only sets of equal size. The result is nan
    for fewer than two images.
    """
    if min(len(found), len(reference)) < 2:
        return math.nan
    difference = found.mean(0) - reference.mean(0)
    a, b = found - found.mean(0), reference - reference.mean(0)
    a, b = a / math.sqrt(len(a) - 1), b / math.sqrt(len(b) - 1)
    # the trace of the square root of the covariances' product equals the nuclear norm of this smaller matrix
    root = np.linalg.norm(a @ b.T, ord="nuc")
    return float(difference @ difference + (a**2).sum() + (b**2).sum() - 2 * root)


def kernel_distance(found: Float[np.ndarray, "n d"], reference: Float[np.ndarray, "m d"], *, seed: int = 0) -> float:
    """Compute KID (Binkowski et al. 2018): the unbiased squared maximum mean discrepancy, kernel (x.y / d + 1)^3.

    The result is the mean over 100 random subsets of 50 images, or of one set if there are fewer. It is nan for fewer
    than two images.
    """
    size = min(len(found), len(reference), _KID_SIZE)
    if size < 2:
        return math.nan
    generator = np.random.default_rng(seed)
    subsets = 1 if size == len(found) == len(reference) else _KID_SUBSETS
    values = []
    for _ in range(subsets):
        x = found[generator.choice(len(found), size, replace=False)]
        y = reference[generator.choice(len(reference), size, replace=False)]
        within = [(_kernel(z, z).sum() - np.trace(_kernel(z, z))) / (size * (size - 1)) for z in (x, y)]
        values.append(sum(within) - 2 * _kernel(x, y).mean())
    return float(np.mean(values))


def _kernel(x: Float[np.ndarray, "n d"], y: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "n m"]:
    return (x @ y.T / x.shape[1] + 1) ** 3
