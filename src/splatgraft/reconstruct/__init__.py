"""Reconstruction of a 3DGS scene from posed images. Knows nothing about files."""

from splatgraft.reconstruct.memory import predict_memory
from splatgraft.reconstruct.options import ReconstructOptions
from splatgraft.reconstruct.training import reconstruct

__all__ = ["ReconstructOptions", "predict_memory", "reconstruct"]
