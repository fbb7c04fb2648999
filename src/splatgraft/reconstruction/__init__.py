"""Reconstruction of a 3DGS scene from posed images (3D Gaussian Splatting, Kerbl et al. 2023)."""

from splatgraft.reconstruction.options import (
    ReconstructOptions,
    describe_duration,
    predict_cpu_seconds,
    predict_memory,
)
from splatgraft.reconstruction.training import reconstruct

__all__ = ["ReconstructOptions", "describe_duration", "predict_cpu_seconds", "predict_memory", "reconstruct"]
