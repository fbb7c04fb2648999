"""Object masks of single images by the network BiRefNet (Zheng et al. 2024), run by onnxruntime."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import resize
from splatgraft.segmentation.onnx_networks import IMAGENET_MEAN, IMAGENET_STD, open_network, require

DEFAULT_REPOSITORY = "onnx-community/BiRefNet-ONNX"
_FILE = "onnx/model.onnx"


@dataclass(frozen=True)
class BiRefNet:
    """A loaded network that finds the foreground of an image."""

    session: Any
    """An onnxruntime.InferenceSession with one input (1, 3, side, side) and logits or probabilities out."""
    side: int
    """Width and height of the network's input, pixels."""

    def mask(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
        """Share of each pixel that is foreground, in [0, 1]."""
        square = (resize(image, self.side, self.side) - IMAGENET_MEAN) / IMAGENET_STD
        given = {self.session.get_inputs()[0].name: square.permute(2, 0, 1)[None].contiguous().numpy()}
        # the last output is the finest where a network gives several
        found = torch.from_numpy(np.asarray(self.session.run(None, given)[-1], np.float32))
        found = found.reshape(found.shape[-2:])
        if float(found.min()) < 0 or float(found.max()) > 1:
            found = found.sigmoid()
        return resize(found, image.shape[1], image.shape[0])


def load_birefnet(weights: Path | str = DEFAULT_REPOSITORY, *, threads: int = 2) -> BiRefNet:
    """Load the network.

    Args:
        weights: An .onnx file, or a repository on the Hugging Face hub, downloaded once; none of its code runs.
        threads: CPU threads.

    Raises:
        ValueError: Where a package is missing, or the file is no such network.
    """
    path = weights if isinstance(weights, Path) else _from_hub(weights)
    session = open_network(path, method="birefnet", threads=threads)
    shape = session.get_inputs()[0].shape
    if len(shape) != 4 or shape[1] not in (3, "channels", "num_channels"):
        raise ValueError(f"{path}: expected an input of shape (1, 3, side, side), found {shape}")
    # a free side is written as a name; BiRefNet was trained at 1024
    return BiRefNet(session=session, side=shape[2] if isinstance(shape[2], int) else 1024)


def _from_hub(repository: str) -> Path:
    require("huggingface_hub", "birefnet")
    import huggingface_hub

    try:
        return Path(huggingface_hub.hf_hub_download(repository, _FILE))
    except Exception as error:  # network, repository or file is missing: a user error in each case
        raise ValueError(
            f"{repository}: expected to download {_FILE} from the hub, found {type(error).__name__}; "
            "give the path of an .onnx file, or use grabcut"
        ) from error
