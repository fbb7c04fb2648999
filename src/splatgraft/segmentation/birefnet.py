"""Object masks of single images by the network BiRefNet (Zheng et al. 2024), run by onnxruntime."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import resize
from splatgraft.runtime.weights.catalogue import ModelWeights
from splatgraft.runtime.weights.hub import fetch
from splatgraft.runtime.weights.store import folder_of, is_stored
from splatgraft.segmentation.onnx_networks import IMAGENET_MEAN, IMAGENET_STD, open_network, require, runs_on_cuda

DEFAULT_REPOSITORY = "onnx-community/BiRefNet-ONNX"
_FILE = "onnx/model.onnx"


_AT_ONCE_ON_CUDA = 4
"""Images in one pass of the network; about 3 GB each at 1024 pixels, by its largest activations. An estimate."""


@dataclass(frozen=True)
class BiRefNet:
    """A loaded network that finds the foreground of images."""

    session: Any
    """An onnxruntime.InferenceSession with one input (n, 3, side, side) and logits or probabilities out."""
    side: int
    """Width and height of the network's input, pixels."""
    at_once: int = 1
    """Images that it takes in one pass."""

    @property
    def place(self) -> str:
        """Where it computes, for messages."""
        return (
            "CUDA" if runs_on_cuda(self.session) else f"{self.session.get_session_options().intra_op_num_threads} cores"
        )

    def mask(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
        """Share of each pixel that is foreground, in [0, 1]."""
        return next(self.masks([image]))

    def masks(self, images: Iterable[Float[Tensor, "_ _ 3"]]) -> Iterator[Float[Tensor, "_ _"]]:
        """Share of each pixel that is foreground, in [0, 1], of each image in order; `at_once` images are held."""
        waiting: list[Tensor] = []
        for image in images:
            waiting.append(image)
            if len(waiting) == self.at_once:
                yield from self._pass(waiting)
                waiting = []
        if waiting:
            yield from self._pass(waiting)

    def _pass(self, images: list[Tensor]) -> Iterator[Tensor]:
        squares = [(resize(image, self.side, self.side) - IMAGENET_MEAN) / IMAGENET_STD for image in images]
        given = {self.session.get_inputs()[0].name: torch.stack(squares).permute(0, 3, 1, 2).contiguous().numpy()}
        # the last output is the finest where a network gives several
        made = torch.from_numpy(np.asarray(self.session.run(None, given)[-1], np.float32))
        for image, found in zip(images, made.reshape(len(images), *made.shape[-2:]), strict=True):
            shares = found.sigmoid() if float(found.min()) < 0 or float(found.max()) > 1 else found
            yield resize(shares, image.shape[1], image.shape[0])


def load_birefnet(weights: Path | str = DEFAULT_REPOSITORY, *, threads: int | None = None) -> BiRefNet:
    """Load the network.

    Args:
        weights: An .onnx file, or a repository on the Hugging Face hub, downloaded once; none of its code runs.
        threads: CPU threads, where it runs on the CPU; all cores that this process may use where not given.

    Raises:
        ValueError: Where a package is missing, or the file is no such network.
    """
    path = weights if isinstance(weights, Path) else _from_hub(weights)
    session = open_network(path, method="birefnet", threads=threads)
    shape = session.get_inputs()[0].shape
    if len(shape) != 4 or shape[1] not in (3, "channels", "num_channels"):
        raise ValueError(f"{path}: expected an input of shape (1, 3, side, side), found {shape}")
    # a free side or batch is written as a name; BiRefNet was trained at 1024
    at_once = 1 if isinstance(shape[0], int) or not runs_on_cuda(session) else _AT_ONCE_ON_CUDA
    return BiRefNet(session=session, side=shape[2] if isinstance(shape[2], int) else 1024, at_once=at_once)


def _from_hub(repository: str) -> Path:
    folder = folder_of(repository)
    model = ModelWeights(repository, "masks", repository, files=(_FILE,))
    if not is_stored(folder, model):
        require("huggingface_hub", "birefnet")
        try:
            fetch(model, folder, say=lambda sentence: None)
        except ValueError as error:  # network, repository or file is missing
            raise ValueError(f"{error}; or give the path of an .onnx file, or use grabcut") from error
    return folder / _FILE
