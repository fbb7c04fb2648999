"""Prompts: points and rectangles per picture, from TOML and JSON; broken files are named."""

import pytest
import torch

from splatgraft.core.prompts import ViewPrompt
from splatgraft.project.prompts import read_prompts, write_prompts

TEXT = """
["DSC_1.jpg"]
inside = [[412, 300], [380.5, 351]]
outside = [[100, 500]]
box = [300, 200, 520, 480]
[DSC_2]
inside = [[1, 2]]
"""


def test_toml_and_json_say_the_same(tmp_path):
    (tmp_path / "prompts.toml").write_text(TEXT)
    read = read_prompts(tmp_path / "prompts.toml")
    assert list(read) == ["DSC_1.jpg", "DSC_2"]
    assert torch.equal(read["DSC_1.jpg"].inside, torch.tensor([[412, 300], [380.5, 351]]))
    assert read["DSC_1.jpg"].box == (300.0, 200.0, 520.0, 480.0)
    assert read["DSC_2"].outside.shape == (0, 2)
    write_prompts(tmp_path / "prompts.json", read)
    again = read_prompts(tmp_path / "prompts.json")
    assert again.keys() == read.keys()
    for name, prompt in read.items():
        assert torch.equal(again[name].inside, prompt.inside)
        assert torch.equal(again[name].outside, prompt.outside)
        assert again[name].box == prompt.box


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "expected a table of points per picture"),
        ("[a]\n", "a: expected a table with inside, outside, box"),
        ("[a]\nclick = [[1, 2]]", "a: expected a table with inside, outside, box"),
        ("[a]\ninside = [1, 2]", r"a: expected inside = \[\[x, y\], ...\], found \[1, 2\]"),
        ("[a]\ninside = [[1, nan]]", "a: expected inside"),
        ("[a]\nbox = [5, 5, 1, 9]", r"a: expected box = \[left, top, right, bottom\]"),
        ("[a", "expected TOML"),
    ],
)
def test_broken_files_are_named(tmp_path, text, found):
    path = tmp_path / "prompts.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"prompts.toml: {found}"):
        read_prompts(path)


def test_scaling_moves_points_and_rectangles():
    scaled = ViewPrompt(inside=torch.tensor([[10.0, 20.0]]), box=(0.0, 10.0, 20.0, 30.0)).scaled(0.5, 2.0)
    assert torch.equal(scaled.inside, torch.tensor([[5.0, 40.0]]))
    assert scaled.box == (0.0, 20.0, 10.0, 60.0)
