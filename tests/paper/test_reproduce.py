"""`paper reproduce` with tiny weights: the commands of the page, whole, and killed in every stage."""

import json
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("diffusers")
pytest.importorskip("transformers")
pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from safetensors.torch import load_file
from tiny_models import quiet
from toy_reproduce import write_inputs

from splatgraft.cli import main
from splatgraft_paper.commands.reproduce import STAGES, Reproduce
from splatgraft_paper.training.generate import RelightingOptions

pytestmark = [*quiet, pytest.mark.filterwarnings("ignore::UserWarning")]
PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "training.md"
NAMES = [stage.name for stage in STAGES]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Write data and tiny weights."""
    root = tmp_path_factory.mktemp("reproduced")
    (root / "arguments.json").write_text(json.dumps(write_inputs(root)))
    return root


@pytest.fixture(scope="module")
def whole(inputs):
    """Run all stages but Blender's."""
    arguments = json.loads((inputs / "arguments.json").read_text())
    assert main(["paper", "reproduce", str(inputs / "out"), *arguments]) == 0
    return inputs


def test_the_page_s_commands_are_those_of_the_stages():
    block = re.search(r"<!-- stages -->\n```sh\n(.*?)```", PAGE.read_text(), re.DOTALL)[1].replace("\\\n", " ")
    listed = [shlex.split(line, comments=True) for line in block.splitlines()]
    relighting = RelightingOptions(Path("maps"), renderer=Path("diffusion-renderer"))
    example = Reproduce(Path("out"), Path("dot3d_data"), Path("ORIDa"), relighting)
    assert listed == [["splatgraft", *example.words(name)] for name in NAMES]


@pytest.mark.long
def test_all_stages_lead_to_the_tables_and_a_second_run_does_nothing(whole, capsys):
    found = json.loads((whole / "out/tables/paper.json").read_text())
    assert set(found["by_model"]) == {"Ours", "w/o Blender", "w/o Flux", "w/o Orida"}
    assert set(found["by_model"]["Ours"]) >= {f"psnr {source}" for source in ("Blender", "FLUX", "ORIDa", "Average")}
    assert {row["method"] for row in found["measured"]} == {"copy-paste", "off+flux/paper-l1-dssim"}
    assert not any("split.json" in note for note in found["notes"])
    records = {path: path.stat().st_mtime_ns for path in (whole / "out").glob("stages/*/step.json")}
    assert {path.parent.name for path in records} == set(NAMES) - {"pairs"}
    arguments = json.loads((whole / "arguments.json").read_text())
    assert main(["paper", "reproduce", str(whole / "out"), *arguments]) == 0
    assert {path: path.stat().st_mtime_ns for path in records} == records
    assert "stage " not in capsys.readouterr().err


def test_a_plan_says_hours_disk_and_memory_and_runs_nothing(inputs, capsys):
    arguments = json.loads((inputs / "arguments.json").read_text())
    assert main(["paper", "reproduce", str(inputs / "planned"), *arguments, "--plan"]) == 0
    said = capsys.readouterr().err
    assert re.search(r"paper +to do +490 GB of disk; hours: 48 on 4 H100 \(the paper\)", said)
    assert said.count("memory: about") == 5
    assert "GB free at" in said
    assert not (inputs / "planned" / "stages").exists()


def test_inputs_are_checked_before_the_first_stage(inputs, tmp_path, capsys):
    arguments = json.loads((inputs / "arguments.json").read_text())
    (tmp_path / "settings.toml").write_text("[removel]\nsteps = 1\n")
    for change, line in (
        (["--data", str(tmp_path)], "expected data_3d or data_rotation in it, found neither"),
        (["--orida", str(tmp_path)], "index.csv: expected a table"),
        (["--lights", str(tmp_path)], "expected a folder with .hdr environment maps"),
        (["--settings", str(tmp_path / "settings.toml")], "expected tables among training, embed-flux"),
    ):
        assert main(["paper", "reproduce", str(tmp_path / "out"), *arguments, *change]) == 2
        assert line in capsys.readouterr().err
    assert not (tmp_path / "out" / "stages").exists()


@pytest.mark.long
def test_a_kill_in_every_stage_changes_no_result(whole):
    program = [sys.executable, str(Path(__file__).with_name("toy_reproduce.py")), str(whole)]
    for stage in NAMES[1:]:
        assert subprocess.run([*program, stage], check=False, timeout=600).returncode == -signal.SIGKILL, stage
    subprocess.run(program, check=True, timeout=600)
    plain, killed = (json.loads((whole / out / "tables/paper.json").read_text()) for out in ("out", "killed"))
    assert killed["by_model"] == plain["by_model"]
    assert [row["values"] for row in killed["measured"]] == [row["values"] for row in plain["measured"]]
    name = "without-flux/model/transformer/diffusion_pytorch_model.safetensors"
    one, other = (load_file(whole / out / name) for out in ("out", "killed"))
    assert one.keys() == other.keys()
    assert all(bool((one[key] == other[key]).all()) for key in one)
