"""The command `doctor`: installed and missing packages, with the command that installs each."""

import os
import platform
import shutil
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import torch

from splatgraft.runtime.console import Console
from splatgraft.runtime.kernels import threading_layer
from splatgraft.runtime.optional_dependencies import OPTIONAL_DEPENDENCIES


@dataclass(frozen=True)
class Doctor:
    """List installed and missing packages, and how to install the missing ones."""

    def execute(self, console: Console) -> int:
        """Print one line per item; a missing optional dependency is no error."""
        lines = [
            ("splatgraft", version("splatgraft")),
            ("python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"),
            ("torch", f"{torch.__version__}, {torch.get_num_threads()} threads"),
            ("numba", f"{version('numba')}, threads by {threading_layer()}"),
            ("processor", f"{_cores()} cores"),
            ("memory", _memory()),
            ("disk", f"{shutil.disk_usage('.').free / 2**30:.0f} GiB free here"),
            ("cuda", _cuda()),
        ]
        for name, text in lines:
            console.result(f"{name:<12} {text}")
        console.result("\noptional:")
        for name, extra in OPTIONAL_DEPENDENCIES.items():
            missing = [module for module, package in extra.packages.items() if _version(package) is None]
            there = [f"{package} {_version(package)}" for package in extra.packages.values() if _version(package)]
            state = "there:   " + ", ".join(there) if not missing else f"missing: pip install 'splatgraft[{name}]'"
            console.result(f"{name:<12} {extra.purpose}\n{'':<12} {state}")
        return 0


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _memory() -> str:
    try:
        total, free = (os.sysconf(name) * os.sysconf("SC_PAGE_SIZE") for name in ("SC_PHYS_PAGES", "SC_AVPHYS_PAGES"))
    except (ValueError, OSError, AttributeError):
        return "unknown"
    return f"{total / 2**30:.1f} GiB, {free / 2**30:.1f} GiB of it unused"


def _cuda() -> str:
    if not torch.cuda.is_available():
        built = "" if torch.version.cuda else "; this torch is a CPU build"
        return f"none found{built}; everything runs on the CPU"
    found = ", ".join(torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count()))
    kernels = "" if _version("gsplat") else "; kernels missing: pip install 'splatgraft[cuda]'"
    return f"{found} (torch for CUDA {torch.version.cuda}){kernels}"


COMMAND = Doctor
