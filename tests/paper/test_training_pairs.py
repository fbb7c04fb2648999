"""Sources of training pairs: composites as in the paper, held-out scenes, balanced choices, resuming; relighters."""

import json
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("safetensors")

from tiny_pairs import relit_folder, rendered_folder, shipped_samples

from splatgraft.core.images import read_rgb, write_image
from splatgraft.runtime.console import Console
from splatgraft_paper.commands.generated import OridaPairs
from splatgraft_paper.training.generate import (
    Lighting,
    Photograph,
    SamplePlan,
    choose_balanced,
    generate,
    read_orida,
)
from splatgraft_paper.training.pairs import (
    DataOptions,
    RelitSample,
    crop_to_size,
    open_relit,
    open_rendered,
    open_training_data,
    split_mixture,
)
from splatgraft_paper.training.prompts import ENVIRONMENTS, LIGHTINGS, OBJECTS, prompt
from splatgraft_paper.training.recipes import Recipe
from splatgraft_paper.training.relighters import StandInRelighter


def environment(folder: Path, name: str, bright: str) -> Path:
    """Return a map with light from one side."""
    picture = np.full((16, 32, 3), 0.05, np.float32)
    left, right = slice(16, 31), slice(1, 16)  # phi from the camera's back over its right
    picture[4:10, right if bright == "right" else left] = 10.0
    folder.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(folder / f"{name}.hdr"), picture)
    return folder / f"{name}.hdr"


def test_each_picture_has_a_key_of_its_own_and_a_light_changes_the_composite_alone(tmp_path):
    rendered, relit = open_rendered(rendered_folder(tmp_path / "a")), open_relit(relit_folder(tmp_path / "b", 1))
    for pair in (rendered.pairs[0], relit.pairs[0]):
        assert len({pair.key(role) for role in ("composite", "target", "background", "mask")}) == 4
    one, other = relit.pairs
    assert one.key("target") == other.key("target")
    assert one.key("composite") != other.key("composite")
    # the composite depends on all four pictures: changing one of them changes it
    for path in (one.relit, one.target, one.background, one.mask):
        before = {role: one.key(role) for role in ("composite", "target", "background", "mask")}
        os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))
        changed = {role for role, key in before.items() if one.key(role) != key}
        assert changed == {"composite", *({path.stem} - {one.relit.stem})}


def test_without_a_recipe_the_sources_are_drawn_as_in_the_paper_and_their_shares_are_said(tmp_path):
    rendered, relit = rendered_folder(tmp_path / "a", 5), relit_folder(tmp_path / "b", 1)
    found = open_training_data(DataOptions(pairs=(str(rendered),), generated=(str(relit),), size="16x16"), 0, None)
    paper = {source.option: source.weight for source in Recipe.read("paper").sources}
    assert found.mixture.weights == (paper["pairs"], paper["generated"])
    assert found.lines[0].endswith("54% of the drawn pairs")
    other = DataOptions(pairs=(str(rendered),), generated=(str(relit),), size="16x16", weights=(3.0, 1.0))
    assert "75%" in open_training_data(other, 0, None).lines[0]


def test_scenes_are_held_out_whole_and_draws_follow_the_weights(tmp_path):
    folders = [open_relit(relit_folder(tmp_path / "a", 5)), open_rendered(rendered_folder(tmp_path / "b", 5))]
    train, kept = split_mixture(folders, weights=(3.0, 1.0), held_out=0.2, seed=1)
    for i in range(2):
        ours, theirs = ({pair.group for pair in mixture.pairs[i]} for mixture in (train, kept))
        assert not ours & theirs
        assert len(theirs) == 1
        assert len(ours) == 4
    drawn = [train.draw(i) for i in range(2000)]
    share = sum(pair in folders[0].pairs for pair in drawn) / len(drawn)
    # a binomial share of 2000 draws has a deviation of 0.0097: four of them
    assert abs(share - 0.75) < 0.039
    assert train.draw(1234) == drawn[1234]
    assert set(drawn) == {pair for own in train.pairs for pair in own}
    assert len(kept.all()) == sum(map(len, kept.pairs))


def test_bad_mixtures_are_one_line(tmp_path):
    source = open_relit(relit_folder(tmp_path / "a", 1))
    with pytest.raises(ValueError, match=r"--weights: expected 1 numbers of at least 0, found \[1.0, 2.0\]"):
        split_mixture([source], weights=(1.0, 2.0), held_out=0.1, seed=0)
    with pytest.raises(ValueError, match="training data: expected pairs, found none in no source"):
        split_mixture([], weights=(), held_out=0.1, seed=0)
    with pytest.raises(ValueError, match=r"manifest.jsonl: expected the manifest of generated pairs"):
        open_relit(tmp_path)
    (tmp_path / "manifest.jsonl").write_text("{}\n")
    with pytest.raises(ValueError, match="line 1: expected folder, group and relit"):
        open_relit(tmp_path)


@pytest.mark.parametrize(("h", "w"), [(20, 40), (40, 20), (16, 32), (100, 100)])
def test_a_fitted_picture_has_its_size_and_its_middle(h, w):
    ramp = torch.linspace(0, 1, w).expand(h, w)[..., None]
    made = crop_to_size(ramp, 32, 16)
    assert made.shape == (16, 32, 1)
    # symmetric about the middle, to the rounding of the enlarged size
    assert abs(float(made.mean()) - 0.5) < 0.02


def test_objects_take_turns_in_every_environment_and_lighting():
    made = [prompt(0, i) for i in range(3 * len(OBJECTS))]
    assert set(Counter(p.object for p in made).values()) == {3}
    assert {p.environment for p in made} == set(ENVIRONMENTS)
    assert {p.lighting for p in made} == set(LIGHTINGS)
    assert prompt(0, 5) == made[5]
    assert prompt(1, 5) != made[5]
    words = prompt(0, 5)
    assert words.text.count(words.object) == 2
    assert "with visible contact shadow, everything in focus." in words.text


def test_the_choice_of_photographs_is_balanced():
    photographs = [
        Photograph(Path(f"{o}{s}{i}.jpg"), Path("m"), Path("b"), f"o{o}", f"s{s}")
        for o in range(6)
        for s in range(5)
        for i in range(3 + 10 * (o == 0))  # one object has many more pictures
    ]
    chosen = choose_balanced(photographs, 60, 0)
    assert len(set(chosen)) == 60
    assert max(Counter(p.object for p in chosen).values()) - min(Counter(p.object for p in chosen).values()) <= 1
    assert max(Counter(p.scene for p in chosen).values()) - min(Counter(p.scene for p in chosen).values()) <= 2
    assert choose_balanced(photographs, 60, 0) == chosen
    assert choose_balanced(photographs, 60, 1) != chosen
    assert len(choose_balanced(photographs, 10_000, 0)) == len(photographs)


def test_the_stand_in_tints_the_object_alone_and_is_named_in_records(tmp_path):
    mask = torch.nn.functional.pad(torch.ones(20, 20), (10, 10, 10, 10))
    image = torch.full((40, 40, 3), 0.5)
    red = np.full((16, 32, 3), (0.1, 0.1, 1.0), np.float32)  # in OpenCV's order
    assert cv2.imwrite(str(tmp_path / "red.hdr"), red)
    (relit,) = StandInRelighter().relight(image, mask, [tmp_path / "red.hdr"])
    assert relit[20, 20, 0] > 0.5 > relit[20, 20, 2]
    assert torch.equal(relit[mask == 0], image[mask == 0])
    assert "not DiffusionRenderer" in StandInRelighter().name


def test_a_killed_generation_resumes_and_unsuitable_samples_are_recorded(tmp_path):
    made = []
    samples = {name: sample for name, sample in shipped_samples(4)}

    def wanted():
        for name, sample in samples.items():

            def make(name=name, sample=sample):
                made.append(name)
                mask = torch.zeros_like(sample.mask) if name.endswith("24") else sample.mask
                if name.endswith("25") and len(made) == 3:
                    raise KeyboardInterrupt
                return RelitSample(sample.target, sample.background, mask)

            yield SamplePlan(name, "scene", make, {"prompt": f"a {name}", "licence": "shipped"})

    lighting = Lighting(
        StandInRelighter(), [environment(tmp_path / "maps", side, side) for side in ("left", "right")], 2, 0
    )
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        generate(out, wanted(), lighting, total=3)
    assert generate(out, wanted(), lighting, total=3) == 3
    names = list(samples)
    assert made == [names[0], names[1], names[2], names[2], names[3]]
    note = json.loads((out / "rejected" / f"{names[1]}.json").read_text())
    assert note["reason"] == "object covers 0.0% of the picture"
    lines = [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]
    assert [line["folder"] for line in lines] == [names[0], names[2], names[3]]
    assert all("stand-in" in line["relighter"] and line["licence"] == "shipped" for line in lines)
    assert len(open_relit(out).pairs) == 6
    assert read_rgb(out / "sheet.png").shape == (6 * 240, 3 * 240, 3)
    before = (out / names[0] / "relit_0.png").stat().st_mtime_ns
    assert generate(out, wanted(), lighting, total=3) == 3
    assert (out / names[0] / "relit_0.png").stat().st_mtime_ns == before


def orida(root: Path) -> Path:
    lines = ["image,mask,background,object,scene"]
    for i, (name, sample) in enumerate(shipped_samples(4)):
        root.mkdir(exist_ok=True)
        write_image(root / f"{name}_background.png", sample.background)
        write_image(root / f"{name}.jpg", sample.target)
        write_image(root / f"{name}_mask.png", sample.mask)
        lines.append(f"{name}.jpg,{name}_mask.png,{name}_background.png,object{i % 2},scene{i // 2}")
    (root / "index.csv").write_text("\n".join(lines) + "\n")
    return root


def test_photographs_become_pairs(tmp_path):
    environment(tmp_path / "maps", "left", "left")
    step = OridaPairs(tmp_path / "out", orida(tmp_path / "orida"), number=3, size="48x32")
    step = replace(step, relighting=replace(step.relighting, lights=tmp_path / "maps", each=1, relighter="stand-in"))
    assert step.execute(Console()) == 0
    pairs = open_relit(tmp_path / "out").pairs
    assert len(pairs) == 3
    assert pairs[0].read().target.shape == (32, 48, 3)
    assert {pair.group for pair in pairs} == {"scene0", "scene1"}


def test_a_dataset_of_another_layout_is_one_line(tmp_path):
    with pytest.raises(ValueError, match=r"index.csv: expected a table with the columns image, .*, found no file"):
        read_orida(tmp_path)
    (tmp_path / "index.csv").write_text("image,mask,object,scene\n")
    with pytest.raises(ValueError, match=r"index.csv: expected the columns .*, found no background"):
        read_orida(tmp_path)
    (tmp_path / "index.csv").write_text("image,mask,background,object,scene\na.jpg,b.png,c.png,o,s\n")
    with pytest.raises(ValueError, match=r"index.csv, line 2: expected existing files, found no .*a.jpg"):
        read_orida(tmp_path)
