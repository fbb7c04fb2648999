"""What is heavy or optional is loaded only by who needs it."""

import subprocess
import sys

import pytest

HEAVY = (
    *("gsplat", "diffusers", "transformers", "accelerate", "safetensors", "peft", "bitsandbytes", "pycolmap", "viser"),
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


@pytest.mark.parametrize("words", [[], ["--help"], ["--version"], ["nonsense"]])
def test_the_command_line_answers_before_it_loads_torch(words: list[str]) -> None:
    quiet = "with contextlib.redirect_stdout(io.StringIO()):"
    statement = f"import io, contextlib, splatgraft.cli\n{quiet} splatgraft.cli.main({words})"
    assert not loaded_by(statement) & {*HEAVY, "torch", "numba", "tyro", "rich"}
