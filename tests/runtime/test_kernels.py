"""The cache of numba kernels: a kernel sees changes of the kernels that it inlines from other files."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from splatgraft.runtime import kernels

INNER = """
import numba
from tiny.runtime.kernels import kernel

@kernel
def inner(x):
    return x + {added}

@numba.njit(cache=True)
def plain_inner(x):
    return x + {added}
"""
OUTER = """
import numba
from tiny.inner import inner, plain_inner
from tiny.runtime.kernels import kernel

@kernel
def outer(x):
    return inner(x)

@numba.njit(cache=True)
def plain_outer(x):
    return plain_inner(x)

print(outer(1), sum(outer.stats.cache_hits.values()), plain_outer(1))
"""


@pytest.mark.parametrize("read_only", [False, pytest.param(True, marks=pytest.mark.long)])
def test_an_edit_of_an_inlined_kernel_is_seen(tmp_path, read_only):
    """`kernel` sees the edit wherever the package is installed. numba alone does not, so `kernel` exists."""
    package = tmp_path / "tiny"
    (package / "runtime").mkdir(parents=True)
    (package / "runtime" / "kernels.py").write_text(Path(kernels.__file__).read_text())
    (package / "outer.py").write_text(OUTER)
    if read_only:
        # a file at the path of the cache's folder, because the tests may run as root
        (package / "__pycache__").touch()
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "home")}
    found = []
    for added in (10, 10, 20):
        (package / "inner.py").write_text(INNER.format(added=added))
        found.append(subprocess.check_output([sys.executable, "-m", "tiny.outer"], env=environment, text=True).split())
    results, from_cache, of_numba_alone = zip(*found, strict=True)
    assert results == ("11", "11", "21")
    assert from_cache == ("0", "1", "0")
    assert of_numba_alone == ("11", "11", "11")


LAYERS = """
import importlib.util, sys
from numba.np.ufunc import omppool, parallel
parallel._check_tbb_version_compatible = lambda: None
sys.modules["numba.np.ufunc.tbbpool"] = omppool
for name in sys.argv[1:]:
    sys.modules[f"numba.np.ufunc.{name}"] = None
    delattr(sys.modules["numba.np.ufunc"], name)
from splatgraft.runtime.kernels import threading_layer
print(threading_layer())
"""


@pytest.mark.parametrize(
    ("absent", "named", "layer"),
    [((), None, "omp"), (("omppool",), None, "workqueue"), ((), "workqueue", "workqueue")],
)
def test_tbb_is_not_used_where_it_is_installed_and_the_layer_that_the_user_names_is(absent, named, layer):
    """An installed TBB is simulated: numba would take it first."""
    pytest.importorskip("numba.np.ufunc.omppool")
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_THREADING_LAYER"}
    environment |= {"NUMBA_THREADING_LAYER": named} if named else {}
    program = [sys.executable, "-c", LAYERS, *absent]
    assert subprocess.check_output(program, env=environment, text=True).split() == [layer]
