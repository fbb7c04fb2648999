"""Object masks by BiRefNet and SAM 2, networks in .onnx files that onnxruntime runs.

BiRefNet (Zheng et al. 2024) finds the foreground of an image. SAM 2 (Ravi et al. 2024) finds the object at points or in
a box. Its two networks have the interface of its public exports (samexporter's export_sam2.py, on the hub as
vietanhdev/segment-anything-2-onnx-models):

- Encoder: takes `image`, returns `image_embed`, `high_res_feats_0` and `high_res_feats_1`.
- Decoder: takes these, `point_coords` in pixels of the encoder's picture, `point_labels` (0 background, 1 object, 2 and
  3 corners of a box), `mask_input`, `has_mask_input`, in some exports also `orig_im_size`. It returns `masks` (logits)
  and `iou_predictions`.
"""

import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.images import resize
from splatgraft.core.prompts import ViewPrompt
from splatgraft.runtime.hub import REPOSITORIES, hub_file

BIREFNET_REPOSITORY = REPOSITORIES["birefnet"]
_BIREFNET_FILE = "onnx/model.onnx"
_BIREFNET_SIDE = 1024  # width and height at which BiRefNet was trained, for networks of variable size
_SAM2_FEATURES = ("image_embed", "high_res_feats_0", "high_res_feats_1")
_SAM2_PROMPTS = ("point_coords", "point_labels", "mask_input", "has_mask_input")
_SAM2_MASK_STRIDE = 4  # side of the encoder's picture over that of `mask_input`
_SAM2_MARGIN = 0.05  # added around the box of the 3D selection at each side, over its width and height; set by hand
_IMAGENET_MEAN = torch.tensor([0.485, 0.456, 0.406])  # the networks' normalisation of sRGB in [0, 1]
_IMAGENET_STD = torch.tensor([0.229, 0.224, 0.225])
_CUDA = "CUDAExecutionProvider"


@dataclass(frozen=True)
class BiRefNet:
    """A loaded BiRefNet, which finds the foreground of images."""

    session: Any
    """onnxruntime.InferenceSession with one input (1, 3, side, side) that returns logits or probabilities."""
    side: int
    """Width and height of the network's input, pixels."""

    @property
    def place(self) -> str:
        """Device of the computation, for messages."""
        # without CUDA's libraries, onnxruntime uses the CPU although CUDA was requested
        on_cuda = self.session.get_providers()[0] == _CUDA
        return "CUDA" if on_cuda else f"{self.session.get_session_options().intra_op_num_threads} cores"

    def mask(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
        """Compute the foreground share of each pixel, in [0, 1]."""
        square = _square(image, self.side)[None].numpy()
        # if a network has several outputs, the last is the finest
        made = self.session.run(None, {self.session.get_inputs()[0].name: square})[-1]
        made = torch.from_numpy(np.asarray(made, np.float32))
        found = made.reshape(made.shape[-2:])
        shares = found.sigmoid() if float(found.min()) < 0 or float(found.max()) > 1 else found
        return resize(shares, image.shape[1], image.shape[0])


@dataclass(frozen=True)
class Sam2:
    """A loaded SAM 2: an encoder of pictures and a decoder of prompts."""

    encoder: Any
    """Encoder of pictures, an onnxruntime.InferenceSession."""
    decoder: Any
    """Decoder of prompts, an onnxruntime.InferenceSession."""
    side: int
    """Width and height of the encoder's picture, pixels."""

    def cut(
        self, image: Float[Tensor, "h w 3"], lifted: Float[Tensor, "h w"], prompt: ViewPrompt
    ) -> Float[Tensor, "h w"]:
        """Cut the object out of one picture: the proposed mask, 0 or 1, with the highest predicted IoU."""
        height, width = image.shape[:2]
        names = [output.name for output in self.encoder.get_outputs()]
        given = {self.encoder.get_inputs()[0].name: _square(image, self.side)[None].numpy()}
        features = dict(zip(names, self.encoder.run(None, given), strict=True))
        points, labels = _points((lifted > 0.5).numpy(), prompt)
        factor = np.array([self.side / width, self.side / height], np.float32)
        small = self.side // _SAM2_MASK_STRIDE
        wanted = {name: features[name] for name in _SAM2_FEATURES} | {
            "point_coords": (points * factor)[None].astype(np.float32),
            "point_labels": labels[None].astype(np.float32),
            "mask_input": np.zeros((1, 1, small, small), np.float32),
            "has_mask_input": np.zeros(1, np.float32),
            "orig_im_size": np.array([height, width], np.float32),
        }
        inputs = {entry.name: wanted[entry.name] for entry in self.decoder.get_inputs()}
        outputs = [output.name for output in self.decoder.get_outputs()]
        found = dict(zip(outputs, self.decoder.run(None, inputs), strict=True))
        best = int(np.asarray(found["iou_predictions"]).reshape(-1).argmax())
        logits = np.asarray(found["masks"], np.float32)
        logits = torch.from_numpy(logits.reshape(-1, *logits.shape[-2:])[best].copy())
        return (resize(logits, width, height) > 0).float()


def load_birefnet(weights: Path | str = BIREFNET_REPOSITORY, *, threads: int | None = None) -> BiRefNet:
    """Load BiRefNet.

    Args:
        weights: An .onnx file, or a repository on the Hugging Face hub, downloaded once; none of its code runs.
        threads: CPU threads; by default one for each core that this process may use.

    Raises:
        ValueError: A package or file is missing, or the file is not such a network.
    """
    path = weights if isinstance(weights, Path) else _from_hub(weights)
    session = _opened(path, "birefnet", threads)
    shape = session.get_inputs()[0].shape
    if len(shape) != 4 or shape[1] not in (3, "channels", "num_channels"):
        raise ValueError(f"{path}: expected an input of shape (1, 3, side, side), found {shape}")
    # a variable side is written as a name
    return BiRefNet(session, shape[2] if isinstance(shape[2], int) else _BIREFNET_SIDE)


def load_sam2(encoder: Path, decoder: Path, *, threads: int | None = None) -> Sam2:
    """Load SAM 2 from the .onnx files of its image encoder and prompt decoder.

    Args:
        encoder: File of the encoder.
        decoder: File of the decoder.
        threads: CPU threads; by default one for each core that this process may use.

    Raises:
        ValueError: A package or file is missing, or the networks have other inputs or outputs.
    """
    encodes, decodes = (_opened(path, "sam2", threads) for path in (encoder, decoder))
    shape = encodes.get_inputs()[0].shape
    if len(shape) != 4 or shape[1] != 3 or not isinstance(shape[2], int) or shape[2] != shape[3]:
        raise ValueError(f"{encoder}: expected an input of shape (1, 3, side, side), found {shape}")
    given = [entry.name for entry in decodes.get_inputs()]
    for path, kind, names, found in (
        (encoder, "outputs", _SAM2_FEATURES, [entry.name for entry in encodes.get_outputs()]),
        (decoder, "inputs", (*_SAM2_FEATURES, *_SAM2_PROMPTS), given),
        (decoder, "outputs", ("masks", "iou_predictions"), [entry.name for entry in decodes.get_outputs()]),
    ):
        if not set(names) <= set(found):
            raise ValueError(f"{path}: expected the {kind} {', '.join(names)}, found {', '.join(found)}")
    if unknown := sorted(set(given) - {*_SAM2_FEATURES, *_SAM2_PROMPTS, "orig_im_size"}):
        raise ValueError(f"{decoder}: expected the inputs of SAM 2's decoder, found also {', '.join(unknown)}")
    return Sam2(encodes, decodes, shape[2])


def _square(image: Float[Tensor, "h w 3"], side: int) -> Float[Tensor, "3 s s"]:
    """Resize and normalise an image for the networks."""
    return ((resize(image, side, side) - _IMAGENET_MEAN) / _IMAGENET_STD).permute(2, 0, 1).contiguous()


def _points(
    shown: Bool[np.ndarray, "h w"], prompt: ViewPrompt
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k"]]:
    """Return points (pixels) and labels: the user's, completed by the 3D selection's innermost point and box."""
    inside, box = prompt.inside.numpy(), prompt.box
    if shown.any():
        if not len(inside):
            depth = cv2.distanceTransform(np.pad(shown.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
            row, column = np.unravel_index(int(depth.argmax()), depth.shape)
            inside = np.array([[column + 0.5, row + 0.5]])
        if box is None:
            rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
            x, y = _SAM2_MARGIN * len(columns), _SAM2_MARGIN * len(rows)
            box = (columns[0] - x, rows[0] - y, columns[-1] + 1 + x, rows[-1] + 1 + y)
    corners = np.zeros((0, 2)) if box is None else np.array(box).reshape(2, 2)
    corners = corners.clip(0, np.array(shown.shape[::-1]))
    points = np.concatenate([inside, prompt.outside.numpy(), corners])
    labels = [1.0] * len(inside) + [0.0] * len(prompt.outside) + [2.0, 3.0][: len(corners)]
    return points, np.array(labels)


def _from_hub(repository: str) -> Path:
    _require("huggingface_hub", "birefnet")
    try:
        return hub_file(repository, _BIREFNET_FILE)
    except ValueError as error:  # network, repository or file is missing
        raise ValueError(f"{error}; or give the path of an .onnx file, or use grabcut") from error


def _opened(path: Path, method: str, threads: int | None) -> Any:
    """Open an InferenceSession on CUDA if onnxruntime supports it (the package onnxruntime-gpu), else on the CPU."""
    _require("onnxruntime", method)
    import onnxruntime

    if not path.is_file():
        raise ValueError(f"{path}: expected an .onnx file, found none")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or _usable_cores()
    options.log_severity_level = 3
    there = onnxruntime.get_available_providers()
    providers = [provider for provider in (_CUDA, "CPUExecutionProvider") if provider in there]
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # onnxruntime's own exceptions share no public base class
        raise ValueError(f"{path}: expected an ONNX network, found {str(error).splitlines()[0]}") from error


def _require(module: str, method: str) -> None:
    if find_spec(module) is None:
        raise ValueError(
            f"masks by {method}: expected {module} (pip install 'splatgraft[birefnet]'), found none; or use grabcut"
        )


def _usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
