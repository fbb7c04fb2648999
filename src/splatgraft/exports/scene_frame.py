"""The frame of an exported scene: that of its capture, or upright and in metres, as some formats ask for."""

import torch

from splatgraft.core.rotations import rotation_between
from splatgraft.core.similarity import Similarity
from splatgraft.exports.export_source import ExportSource
from splatgraft.exports.first_view import up_of
from splatgraft.formats import SceneMetadata

_UP = (0.0, -1.0, 0.0)
"""In the axes of a .ply: y points down. Formats whose y points up turn it on writing."""


def upright(source: ExportSource) -> tuple[Similarity, SceneMetadata, tuple[str, ...]]:
    """The transform to a frame whose y is vertical and whose unit is a metre, what is known of it, and what to say.

    The origin stays, and the scene turns as little as it can.
    """
    up, said = up_of(source)
    metres = source.metadata.metres_per_unit
    rotation = rotation_between(up, torch.tensor(_UP))
    moved = Similarity(scale=metres or 1.0, rotation=rotation, translation=torch.zeros(3))
    size = (
        "its size is not known: a unit of the capture is written as a metre; `splatgraft scale` says how large it is"
        if metres is None
        else f"one unit is a metre; one of the capture was {metres:.4g} m"
    )
    return moved, SceneMetadata(_UP, None if metres is None else 1.0), (*said, "turned upright", size)
