"""Networks in .onnx files, opened by onnxruntime."""

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

IMAGENET_MEAN = torch.tensor([0.485, 0.456, 0.406])
"""Of sRGB in [0, 1]; subtracted before the networks see a picture."""
IMAGENET_STD = torch.tensor([0.229, 0.224, 0.225])
"""Of sRGB in [0, 1]; divided by before the networks see a picture."""


_CUDA = "CUDAExecutionProvider"


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def runs_on_cuda(session: Any) -> bool:
    """Whether an onnxruntime session computes on CUDA; it may not, though asked, where CUDA's libraries are missing."""
    return session.get_providers()[0] == _CUDA


def require(module: str, method: str) -> None:
    """Check that an optional package is there.

    Raises:
        ValueError: It is not installed.
    """
    if find_spec(module) is None:
        raise ValueError(
            f"masks by {method}: expected {module} (pip install 'splatgraft[birefnet]'), found none; or use grabcut"
        )


def open_network(path: Path, *, method: str, threads: int | None = None) -> Any:
    """An onnxruntime.InferenceSession on CUDA where onnxruntime has it (the package onnxruntime-gpu), else on the CPU.

    Args:
        path: The .onnx file.
        method: What makes the masks, for messages.
        threads: CPU threads; all cores that this process may use where not given.

    Raises:
        ValueError: Where onnxruntime is missing, or the file is no network.
    """
    require("onnxruntime", method)
    import onnxruntime

    if not path.is_file():
        raise ValueError(f"{path}: expected an .onnx file, found none")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or usable_cores()
    options.log_severity_level = 3
    there = onnxruntime.get_available_providers()
    providers = [provider for provider in (_CUDA, "CPUExecutionProvider") if provider in there]
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # onnxruntime's own exceptions share no public base class
        raise ValueError(f"{path}: expected an ONNX network, found {str(error).splitlines()[0]}") from error
