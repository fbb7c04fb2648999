"""FID and KID of sets of pictures, by Inception features of a kept library. Knows no methods, scenes or regions.

The features are torch-fidelity's (that of the published FID); the library needs a torchvision that fits torch, so it
is no extra of this package. Its weights are read from a given folder, never downloaded.
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
"""From pictures, sRGB in [0, 1], to one row of features each."""
_KID_SUBSETS, _KID_SIZE = 100, 50


def inception_features(folder: Path | None) -> Features:
    """The 2048 features of the published FID, with weights from `folder`, by default torch hub's cache.

    Raises: ValueError where the weights or the library are missing, with a line that says which.
    """
    path = (Path(torch.hub.get_dir()) / "checkpoints" if folder is None else folder) / INCEPTION_FILE
    if not path.is_file():
        raise ValueError(f"{path}: expected Inception weights of torch-fidelity, found no such file")
    try:
        from torch_fidelity.feature_extractor_inceptionv3 import FeatureExtractorInceptionV3
    except (ImportError, RuntimeError) as error:
        raise ValueError(
            f"torch_fidelity: expected an installed package with a torchvision that fits torch, found {error}"
        ) from error
    network = FeatureExtractorInceptionV3("inception-v3-compat", ["2048"], feature_extractor_weights_path=str(path))

    def features(pictures: Sequence[Float[Tensor, "h w 3"]]) -> Float[np.ndarray, "n d"]:
        rows = []
        for picture in pictures:
            bytes_ = (picture.clamp(0, 1) * 255).round().to(torch.uint8).permute(2, 0, 1)[None]
            rows.append(network(bytes_)[0][0].detach().double().numpy())
        return np.stack(rows)

    return features


def frechet_distance(found: Float[np.ndarray, "n d"], wanted: Float[np.ndarray, "m d"]) -> float:
    """FID (Heusel 2017, Eq. 6): distance of the Gaussians that have the sets' means and covariances; nan for under two.

    With fewer pictures than features it is biased upwards: compare only sets of one size.
    """
    if min(len(found), len(wanted)) < 2:
        return math.nan
    difference = found.mean(0) - wanted.mean(0)
    a, b = found - found.mean(0), wanted - wanted.mean(0)
    a, b = a / math.sqrt(len(a) - 1), b / math.sqrt(len(b) - 1)
    # the trace of the root of the product of covariances is the nuclear norm of this small matrix
    root = np.linalg.norm(a @ b.T, ord="nuc")
    return float(difference @ difference + (a**2).sum() + (b**2).sum() - 2 * root)


def kernel_distance(found: Float[np.ndarray, "n d"], wanted: Float[np.ndarray, "m d"], *, seed: int = 0) -> float:
    """KID (Binkowski 2018): unbiased squared maximum mean discrepancy with kernel (x.y / d + 1)^3; nan for under two.

    The mean over 100 random subsets of 50 pictures, or of all where there are fewer (then one subset).
    """
    size = min(len(found), len(wanted), _KID_SIZE)
    if size < 2:
        return math.nan
    generator = np.random.default_rng(seed)
    subsets = 1 if size == len(found) == len(wanted) else _KID_SUBSETS
    values = []
    for _ in range(subsets):
        x = found[generator.choice(len(found), size, replace=False)]
        y = wanted[generator.choice(len(wanted), size, replace=False)]
        within = [(_kernel(z, z).sum() - np.trace(_kernel(z, z))) / (size * (size - 1)) for z in (x, y)]
        values.append(sum(within) - 2 * _kernel(x, y).mean())
    return float(np.mean(values))


def _kernel(x: Float[np.ndarray, "n d"], y: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "n m"]:
    return (x @ y.T / x.shape[1] + 1) ** 3
