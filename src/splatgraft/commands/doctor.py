"""The command `doctor`: what is installed, what is missing, and the command that installs it."""

import os
import platform
import shutil
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import torch

from splatgraft.runtime.console import Console
from splatgraft.runtime.optional_dependencies import OPTIONAL_DEPENDENCIES
from splatgraft.runtime.weights.catalogue import CATALOGUE
from splatgraft.runtime.weights.hub import describe, may_read


@dataclass(frozen=True)
class Doctor:
    """Say what is installed, what is missing and how to install it."""

    online: bool = False
    """Ask the Hugging Face hub about every model: whether it is still there, gated, and open to you."""

    def execute(self, console: Console) -> int:
        """Print one line per item; a missing optional dependency is no error."""
        lines = [
            ("splatgraft", version("splatgraft")),
            ("python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"),
            ("torch", f"{torch.__version__}, {torch.get_num_threads()} threads"),
            ("numba", version("numba")),
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
        if self.online:
            console.result("\nweights on the hub:")
            for repository in dict.fromkeys(model.repository for model in CATALOGUE if model.repository):
                console.result(f"{repository:<44} {_on_the_hub(repository)}")
        return 0


def _on_the_hub(repository: str) -> str:
    """Licence and access of a repository as the hub has them now, or why that is not known."""
    try:
        found = describe(repository)
        if not found.gated:
            return f"there; licence {found.licence}; free access"
        access = "gated, open to you" if may_read(repository) else "gated, closed to you"
        return f"there; licence {found.licence}; {access}: https://huggingface.co/{repository}"
    except ValueError as error:
        return str(error).removeprefix(f"{repository}: ")


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
