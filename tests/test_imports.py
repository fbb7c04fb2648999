"""Heavy and optional modules are loaded only by the code that needs them."""

import subprocess
import sys

HEAVY = (
    *("gsplat", "diffusers", "transformers", "accelerate", "peft", "bitsandbytes", "pycolmap", "uvicorn"),
    *("bpy", "ray", "onnxruntime", "huggingface_hub"),
)


def loaded_by(statement: str) -> set[str]:
    script = f"import sys\n{statement}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_the_package_loads_nothing_heavy() -> None:
    assert not loaded_by("import splatgraft") & {*HEAVY, "torch", "numba", "numpy"}


def test_all_steps_load_no_optional_library() -> None:
    assert not loaded_by(
        "import splatgraft.workflow.flow, splatgraft.commands.doctor, splatgraft_paper.commands.train"
    ) & set(HEAVY)


def test_the_command_line_answers_before_it_loads_torch() -> None:
    quiet = "with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):"
    calls = "; ".join(f"splatgraft.cli.main({words})" for words in ([], ["--help"], ["--version"], ["nonsense"]))
    statement = f"import io, contextlib, splatgraft.cli\n{quiet} {calls}"
    assert not loaded_by(statement) & {*HEAVY, "torch", "numba", "tyro", "rich"}


WITHOUT_POSIX = """
import importlib, pkgutil, sys
for name in ("resource", "fcntl", "pwd", "grp", "termios", "tty", "pty", "syslog", "readline"):
    sys.modules[name] = None  # import raises ModuleNotFoundError
import splatgraft
for module in pkgutil.walk_packages(splatgraft.__path__, "splatgraft."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
from splatgraft.runtime import process
read = process.Path.is_file
process.Path.is_file = lambda path: path.parts[1] != "proc" and read(path)
process.reset_peak_memory()
print(process.peak_memory_bytes())
"""


def test_the_whole_package_is_imported_without_modules_that_windows_lacks() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_POSIX], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "0\n"
