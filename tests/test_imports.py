"""Heavy and optional modules are loaded only by the code that needs them."""

import subprocess
import sys

HEAVY = (
    *("gsplat", "diffusers", "transformers", "accelerate", "peft", "bitsandbytes", "pycolmap", "viser"),
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
