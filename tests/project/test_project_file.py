"""project.toml: every key that a template offers is understood."""

import re
import tomllib
from pathlib import Path

import pytest

from splatgraft.cli import main
from splatgraft.project.project_file import TEMPLATE
from splatgraft.project.step_table import STEPS
from splatgraft.workflow.flow import read_flow
from splatgraft.workflow.project_reference import full_project_text, project_keys

SIDES = {"source": 'capture = "a"', "target": 'capture = "b"'}


def template() -> str:
    return TEMPLATE.replace("{source}", SIDES["source"]).replace("{target}", SIDES["target"])


def with_one_key(lines: list[str], at: int, mark: str) -> str:
    """Return the text with line `at` uncommented, and the header of its table if that is commented."""
    chosen = list(lines)
    header = max(i for i in range(at) if re.match(r"(# )?\[[\w.]+\]\s*(#.*)?$", lines[i]))
    for i in (header, at):
        chosen[i] = lines[i].removeprefix("# ").removeprefix(mark)
    return "\n".join(chosen)


def with_all_defaults(text: str) -> str:
    """Return the full file with every key uncommented that has a default, except those of a method."""
    defaults = {(table.name, key.name) for table in project_keys() for key in table.keys if key.default == key.example}
    lines, table = [], ""
    for line in text.splitlines():
        if found := re.match(r"\[(.*)\]$|# with ", line):
            table = found[1]
        key = re.match(r"#(\w+) = ", line)
        lines.append(line[1:] if key and (table, key[1]) in defaults else line)
    return "\n".join(lines)


def test_every_key_that_the_template_offers_is_understood(tmp_path: Path) -> None:
    lines = template().splitlines()
    offered = [i for i, line in enumerate(lines) if re.match(r"# \w+ = ", line)]
    assert len(offered) > 10
    for at in offered:
        (tmp_path / "project.toml").write_text(with_one_key(lines, at, "# "))
        read_flow(tmp_path)


def test_every_key_of_the_full_file_is_understood(tmp_path: Path) -> None:
    lines = full_project_text(**SIDES).splitlines()
    read = 0
    choice = ""
    for at, line in enumerate(lines):
        if found := re.match(r"# with (\w+ = \"[\w-]+\"):", line):
            choice = found[1]
        if line.startswith("["):
            choice = ""
        if re.match(r"#\w+ = ", line):
            text = with_one_key(lines, at, "#")
            text = text.replace("[harmonize]", f"[harmonize]\n{choice}") if choice else text
            (tmp_path / "project.toml").write_text(text)
            read_flow(tmp_path)
            read += 1
    tables = project_keys()
    # the captures of both sides are set, not commented
    assert read == sum(len(t.keys) + sum(len(v.keys) for v in t.variants) for t in tables) - 2


def test_the_defaults_of_the_full_file_change_nothing(tmp_path: Path) -> None:
    plain, full = tmp_path / "plain", tmp_path / "full"
    for folder in (plain, full):
        folder.mkdir()
    (plain / "project.toml").write_text("".join(f"[{side}]\n{line}\n" for side, line in SIDES.items()))
    (full / "project.toml").write_text(with_all_defaults(full_project_text(**SIDES)))
    assert len(tomllib.loads((full / "project.toml").read_text())["segment"]) > 5
    root = Path("root")
    for (_, one), (_, other) in zip(read_flow(plain, root), read_flow(full, root), strict=True):
        paths = {name for name, value in vars(one).items() if isinstance(value, Path)}
        assert {k: v for k, v in vars(one).items() if k not in paths} == {
            k: v for k, v in vars(other).items() if k not in paths
        }


def test_every_table_and_key_is_described() -> None:
    tables = {table.name: table for table in project_keys()}
    assert list(tables) == ["source", "target", *(row.command for row in STEPS if row.has_table)]
    keys = {key.name: key for key in tables["consolidate"].keys}
    assert (keys["nuisance"].type, keys["nuisance"].default) == ('"tint-flow" or "none"', '"tint-flow"')
    assert keys["scene"].default == '"relit/scene.ply"'
    assert keys["passes"].meaning
    flux = next(variant for variant in tables["harmonize"].variants if variant.name == "flux")
    assert "sampling_steps" in [key.name for key in flux.keys]
    unexplained = [f"{t.name} {k.name}" for t in tables.values() for k in t.keys if not k.meaning]
    assert not unexplained


def test_init_full_writes_a_project_with_every_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", str(tmp_path / "p"), "--source", str(tmp_path), "--target", str(tmp_path), "--full"]) == 0
    text = (tmp_path / "p" / "project.toml").read_text()
    assert "#sampling_steps = 4" in text
    assert "#sun_through = []" in text
    assert max(map(len, text.splitlines())) <= 120
    assert set(tomllib.loads(text)) == {table.name for table in project_keys()}


@pytest.mark.parametrize("folder", ["target/capture", "target/scene/photos", "report"])
def test_a_step_that_would_read_its_own_or_a_later_result_is_refused(tmp_path, folder):
    (tmp_path / "project.toml").write_text(f'[source]\ncapture = "photos"\n[target]\ncapture = "{folder}"\n')
    with pytest.raises(ValueError, match=r"project.toml: expected inputs of target/capture elsewhere than in the res"):
        read_flow(tmp_path)
