"""Numba kernels: cached under a hash of all their sources, and run one at a time in a process."""

import functools
import hashlib
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

FAST_MATH = {"contract", "nsz", "arcp", "reassoc"}
"""LLVM's fast-math flags that keep nan and infinity."""
KERNEL_LOCK = threading.Lock()
"""Held while a kernel runs: without OpenMP numba uses its workqueue layer, which aborts the process when two threads
start kernels at the same time."""

# OpenMP shares its threads with torch. TBB, numba's first choice, may wait for minutes at the end of a busy process.
numba.config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]  # pyright: ignore

_IMPORT = re.compile(rb"^(?:from [\w.]+ )?import (?:\([^)]*\)|.*)", re.MULTILINE)


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile with `numba.njit`; changes of imported kernel files also renew the cached machine code.

    Numba itself compares only the function's own file, and would keep running code inlined from another file. Constants
    that kernels use must be in files with kernels, because only those are compared.
    """
    if function is None:
        return functools.partial(kernel, **options)
    compiled: Any = numba.njit(cache=True, **options)(function)
    index = compiled._cache._cache_file
    index._source_stamp = (index._source_stamp, _hash_of_sources(Path(function.__code__.co_filename)))
    return compiled


@functools.cache
def _kernel_sources() -> dict[Path, bytes]:
    """Read all files of the package that name numba or this module."""
    sources = {path: path.read_bytes() for path in sorted(Path(__file__).parents[1].rglob("*.py"))}
    return {path: text for path, text in sources.items() if b"numba" in text or b"runtime.kernels" in text}


@functools.cache
def _hash_of_sources(file: Path) -> str:
    """Hash a kernel file with the kernel files that it imports, directly or through others."""
    sources = _kernel_sources()
    reached, found = set(), {file}
    while found:
        reached |= found
        imports = b" ".join(part for path in found for part in _IMPORT.findall(sources[path]))
        words = set(re.findall(rb"\w+", imports))
        found = {path for path in sources if path.stem.encode() in words} - reached
    return hashlib.sha256(b"\0".join(sources[path] for path in sorted(reached))).hexdigest()


def threading_layer() -> str:
    """Return the library whose threads run numba's kernels: omp, else workqueue; NUMBA_THREADING_LAYER overrides it."""
    numba.get_num_threads()  # chooses the layer
    return numba.threading_layer()  # pyright: ignore[reportPrivateImportUsage]


def serialized(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap `kernel` to run under the lock; must not be called while the lock is held, nor from another kernel."""

    @functools.wraps(kernel)
    def call(*args: Any) -> Any:
        with KERNEL_LOCK:
            return kernel(*args)

    return call
