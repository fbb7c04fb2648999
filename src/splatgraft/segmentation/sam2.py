"""The object's mask in one picture by SAM 2 (Ravi et al. 2024), as two ONNX networks run by onnxruntime.

The interface is that of the public exports (samexporter's export_sam2.py, on the hub as
vietanhdev/segment-anything-2-onnx-models): the encoder takes `image` and gives `image_embed`, `high_res_feats_0`,
`high_res_feats_1`; the decoder takes these, `point_coords` in pixels of the encoder's picture, `point_labels` (0 beside
the object, 1 on it, 2 and 3 corners of a box), `mask_input`, `has_mask_input`, and gives `masks` (logits) and
`iou_predictions`. Some decoders also take `orig_im_size`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import resize
from splatgraft.segmentation.onnx_networks import IMAGENET_MEAN, IMAGENET_STD, open_network
from splatgraft.segmentation.view_cutter import Evidence

_FEATURES = ("image_embed", "high_res_feats_0", "high_res_feats_1")
_PROMPTS = ("point_coords", "point_labels", "mask_input", "has_mask_input")
_MASK_STRIDE = 4
"""Side of the encoder's picture over that of `mask_input`."""


@dataclass(frozen=True)
class Sam2:
    """A loaded SAM 2: an encoder of pictures and a decoder of prompts."""

    encoder: Any
    """An onnxruntime.InferenceSession."""
    decoder: Any
    """An onnxruntime.InferenceSession."""
    side: int
    """Width and height of the encoder's picture, pixels."""
    margin: float = 0.05
    """Added around the box of the 3D selection at each side, over its width and height; set by hand."""

    def cut(self, image: Float[Tensor, "h w 3"], evidence: Evidence) -> Float[Tensor, "h w"]:
        """The object's mask, 0 or 1: of the networks' proposals the one that they predict to be the best."""
        height, width = image.shape[:2]
        square = (resize(image, self.side, self.side) - IMAGENET_MEAN) / IMAGENET_STD
        names = [output.name for output in self.encoder.get_outputs()]
        given = {self.encoder.get_inputs()[0].name: square.permute(2, 0, 1)[None].contiguous().numpy()}
        features = dict(zip(names, self.encoder.run(None, given), strict=True))
        points, labels = self._points(evidence)
        factor = np.array([self.side / width, self.side / height], np.float32)
        small = self.side // _MASK_STRIDE
        wanted = {name: features[name] for name in _FEATURES} | {
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

    def _points(self, evidence: Evidence) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k"]]:
        """Points and labels, pixels of the picture: what the user says, else the 3D selection's box and middle."""
        prompt, shown = evidence.prompt, (evidence.lifted > 0.5).numpy()
        inside, box = prompt.inside.numpy(), prompt.box
        if shown.any():
            if not len(inside):
                depth = cv2.distanceTransform(np.pad(shown.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
                row, column = np.unravel_index(int(depth.argmax()), depth.shape)
                inside = np.array([[column + 0.5, row + 0.5]])
            if box is None:
                rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
                x, y = self.margin * len(columns), self.margin * len(rows)
                box = (columns[0] - x, rows[0] - y, columns[-1] + 1 + x, rows[-1] + 1 + y)
        corners = np.zeros((0, 2)) if box is None else np.array(box).reshape(2, 2)
        corners = corners.clip(0, np.array(shown.shape[::-1]))
        points = np.concatenate([inside, prompt.outside.numpy(), corners])
        labels = [1.0] * len(inside) + [0.0] * len(prompt.outside) + [2.0, 3.0][: len(corners)]
        return points, np.array(labels)


def load_sam2(encoder: Path, decoder: Path, *, threads: int | None = None) -> Sam2:
    """Load the networks.

    Args:
        encoder: An .onnx file of the image encoder.
        decoder: An .onnx file of the prompt decoder that belongs to it.
        threads: CPU threads; all cores that this process may use where not given.

    Raises:
        ValueError: Where onnxruntime is missing, or a file is no such network.
    """
    encodes, decodes = (open_network(path, method="sam2", threads=threads) for path in (encoder, decoder))
    shape = encodes.get_inputs()[0].shape
    if len(shape) != 4 or shape[1] != 3 or not isinstance(shape[2], int) or shape[2] != shape[3]:
        raise ValueError(f"{encoder}: expected an input of shape (1, 3, side, side), found {shape}")
    _expect(encoder, "outputs", _FEATURES, [entry.name for entry in encodes.get_outputs()])
    given = [entry.name for entry in decodes.get_inputs()]
    _expect(decoder, "inputs", (*_FEATURES, *_PROMPTS), given)
    if unknown := sorted(set(given) - {*_FEATURES, *_PROMPTS, "orig_im_size"}):
        raise ValueError(f"{decoder}: expected the inputs of SAM 2's decoder, found also {', '.join(unknown)}")
    _expect(decoder, "outputs", ("masks", "iou_predictions"), [entry.name for entry in decodes.get_outputs()])
    return Sam2(encoder=encodes, decoder=decodes, side=shape[2])


def _expect(path: Path, kind: str, names: tuple[str, ...], found: list[str]) -> None:
    if not set(names) <= set(found):
        raise ValueError(f"{path}: expected the {kind} {', '.join(names)}, found {', '.join(found)}")
