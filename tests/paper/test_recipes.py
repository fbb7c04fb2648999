"""Recipes hold the paper's numbers, are printed before anything is loaded, and the user's own options override them."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("diffusers")

from tiny_pairs import relit_folder
from tiny_training import QUICK, training

from splatgraft.cli import main
from splatgraft.reconstruction.options import available_memory
from splatgraft.runtime.hub import REPOSITORIES, hub_id
from splatgraft_paper.training import recipes as recipes_module
from splatgraft_paper.training.flux import FluxTrainingOptions, training_memory
from splatgraft_paper.training.pairs import DataOptions
from splatgraft_paper.training.recipes import Recipe
from splatgraft_paper.training.removal import RemovalTrainingOptions

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
WEIGHTS = Path(__file__).parents[2] / "docs" / "reference" / "weights.md"
SOURCES = {"pairs": (1900, 51_000), "generated": (1600, 6500), "orida": (2000, 8000)}
"""Consistent and inconsistent pictures of the paper's three sources (Sec. 5.2)."""


def test_the_harmoniser_has_the_paper_s_numbers():
    recipe = Recipe.read("paper")
    # Sec. 5.3: 50K iterations, 4 H100, 704 x 496, Adam, 3e-5, total batch size of 4
    wanted = {"steps": 50_000, "rate": 3e-5, "batch": 4, "size": "704x496"}
    assert {name: recipe.options[name] for name in wanted} == wanted
    assert recipe.processes == 4
    assert {source.option: (source.targets, source.composites) for source in recipe.sources} == SOURCES
    # Sec. 5: conditioned on composite and mask, the first layer repeated, FLUX.1-schnell
    assert recipe.options["condition"] == "image-mask"
    assert recipe.options["first-layer"] == "repeat"
    assert recipe.options["base"] == "flux"


def test_the_object_removal_has_the_paper_s_numbers():
    recipe = Recipe.read("removal")
    # Sec. 5.3: Stable Diffusion 2, a single H100, batch size of 8, 1e-5, 260K iterations, the synthetic data
    wanted = {"steps": 260_000, "rate": 1e-5, "batch": 8, "base": "stable-diffusion"}
    assert {name: recipe.options[name] for name in wanted} == wanted
    assert recipe.processes == 1
    assert [source.option for source in recipe.sources] == ["pairs"]


@pytest.mark.parametrize(("name", "left_out"), [("blender", "pairs"), ("flux", "generated"), ("orida", "orida")])
def test_an_ablation_is_the_paper_s_training_without_one_source(name, left_out):
    paper, ablation = Recipe.read("paper"), Recipe.read(f"without-{name}")
    assert ablation.options == paper.options
    assert ablation.sources == tuple(source for source in paper.sources if source.option != left_out)
    names = {source.option: source.name for source in paper.sources}
    assert ablation.licences == {key: text for key, text in paper.licences.items() if key != names[left_out]}


def test_every_base_is_a_known_repository_and_every_repository_is_documented_with_its_licence():
    recipes = Path(recipes_module.__file__).with_name("recipe_files").glob("*.toml")
    bases = {Recipe.read(path.stem).options["base"] for path in recipes}
    assert bases - {"tiny"} <= set(REPOSITORIES)
    assert FluxTrainingOptions().base in REPOSITORIES
    assert RemovalTrainingOptions().base in REPOSITORIES
    rows = [line.split("|") for line in WEIGHTS.read_text().splitlines() if line.startswith("| `")]
    licences = {row[1].split("`")[1]: row[3].strip() for row in rows}
    assert all(licences.get(repository) for repository in REPOSITORIES.values())
    assert hub_id("dot3d") == "nviolante/dot3d"
    assert hub_id("someone/else") == "someone/else"


def test_a_plan_says_what_will_run_and_loads_nothing(tmp_path, capsys):
    words = ["paper", "train", "flux", str(tmp_path / "out"), "--recipe", "paper", "--plan"]
    assert main(words) == 0
    printed = capsys.readouterr().err
    for line in (
        "recipe paper: the paper's harmoniser (Sec. 5), about two days on 4 H100",
        "plan: 50,000 steps of 4 pairs at 704x496, Adam at 3e-05, on 4 GPUs",
        "data: Blender (--pairs), 1,900 targets and 51,000 composites, 35% of the drawn pairs",
        "licence: FLUX.1-schnell: Apache-2.0",
        "licence: ORIDa: its own terms",
    ):
        assert line in printed
    assert not (tmp_path / "out").exists()
    # the user's options override those of the recipe
    assert main([*words, "--steps", "10", "--batch", "8"]) == 0
    assert "plan: 10 steps of 8 pairs" in capsys.readouterr().err
    assert main(["paper", "train", "removal", str(tmp_path / "out"), "--recipe", "removal", "--plan"]) == 0
    printed = capsys.readouterr().err
    assert "plan: 260,000 steps of 8 pairs at 704x496, Adam at 1e-05, on 1 GPUs" in printed
    assert "licence: Stable Diffusion 2: CreativeML Open RAIL++-M; a mirror" in printed


def test_weights_are_shared_by_the_folders_of_a_source():
    recipe = Recipe.read("paper")
    assert recipe.weights({"pairs": 2, "generated": 1, "orida": 1}) == (0.95, 0.95, 1.6, 2.0)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["--recipe", "paper"],
            "training data: expected --pairs, --generated, --orida (recipe paper), found no --pairs",
        ),
        (["--recipe", "without-orida", "--pairs", "a", "--generated", "b", "--orida", "c"], "--orida: expected none"),
        (["--recipe", "papper"], "--recipe: expected a file or one of paper, removal, tiny, without-blender,"),
        (["--recipe", "removal"], "--recipe: expected a recipe of `train flux` (paper, tiny, without-blender,"),
    ],
)
def test_what_does_not_fit_a_recipe_is_one_line(tmp_path, capsys, words, line):
    assert main(["paper", "train", "flux", str(tmp_path / "out"), *words]) == 2
    assert line in capsys.readouterr().err


def test_a_recipe_of_one_s_own_is_a_file(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    path.write_text('title = "mine"\ncommand = "train flux"\nprocesses = 2\n[options]\nsteps = 7\n[sources]\n')
    assert main(["paper", "train", "flux", str(tmp_path / "out"), "--recipe", str(path), "--plan"]) == 0
    assert "plan: 7 steps of 4 pairs" in capsys.readouterr().err
    path.write_text("title = 3\n")
    assert main(["paper", "train", "flux", str(tmp_path / "out"), "--recipe", str(path), "--plan"]) == 2
    assert "mine.toml: expected a recipe with the keys of the shipped ones, found" in capsys.readouterr().err


def said_memory(capsys, *words):
    """Return GB on each device, of the machine and of the disk, from the printed plan."""
    capsys.readouterr()
    assert main(["paper", "train", *words, "--plan"]) == 0
    line = next(line for line in capsys.readouterr().err.splitlines() if line.startswith("memory: about"))
    return [float(number.replace(",", "")) for number in re.findall(r"([\d,.]+) GB", line)], line


def test_a_plan_says_the_memory_of_the_paper_s_training_in_shards_and_in_copies(tmp_path, capsys):
    words = ("flux", str(tmp_path / "out"), "--recipe", "paper")
    (device, host, disk), line = said_memory(capsys, *words)
    assert "on each GPU (4, in shards)" in line
    # FLUX.1-schnell has 11.89 billion weights: 16 bytes each over four GPUs, and 2 bytes for casts; an H100 has 80 GB
    assert 11.89 * 16 / 4 < device < 80
    # each process loads 4 bytes a weight
    assert 4 * 11.89 * 4 < host < 4 * 11.9 * 4
    # three states of 12 bytes a weight, and the model
    assert 11.89 * 40 < disk < 11.9 * 40
    (device, *_), line = said_memory(capsys, *words, "--parallel", "copies")
    assert "a copy of all weights in each" in line
    assert 11.89 * 16 < device < 210
    (device, *_), _ = said_memory(capsys, *words, "--lora", "16", "--parallel", "copies")
    assert 2 * 11.89 < device < 40
    # Stable Diffusion 2's UNet has 866 million weights
    (device, host, disk), _ = said_memory(capsys, "removal", str(tmp_path / "out"), "--recipe", "removal")
    assert 16 * 0.866 < device < 40
    assert host == pytest.approx(4 * 0.866, abs=0.1)


def test_what_cannot_fit_is_refused_before_anything_is_loaded(tmp_path, capsys):
    if (available_memory("cpu") or 0) > 190e9 and shutil.disk_usage(tmp_path).free > 500e9:
        pytest.skip("this machine could train FLUX")
    words = ["paper", "train", "flux", str(tmp_path / "out"), "--cpu", "--generated", str(relit_folder(tmp_path / "a"))]
    for plan in ([], ["--plan"]):
        assert main([*words, *plan]) == 2
        said = capsys.readouterr().err
        assert re.search(r"training: expected about [1-4]\d\d\.\d GB .*, found .* GB; try --parallel shards", said)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("more", [{}, {"ema": 0.5}])
def test_the_counted_bytes_are_those_of_a_training(tmp_path, more):
    loop = replace(QUICK, steps=2, **more)
    run = training(tmp_path, "out", loop)
    run.train()
    options = FluxTrainingOptions(base=str(tmp_path / "base"), data=DataOptions(size="32x32"), loop=loop)
    memory = training_memory(options, loop, 1)
    network = run.task.network
    count = sum(p.numel() for p in network.parameters())
    copies = 5 if more else 4  # weights, gradients and Adam's two moments; the average
    assert memory.state == 4 * copies * count
    # a state lacks the gradients; torch.save adds 2.2 KB of names and padding to each tensor
    (state,) = (tmp_path / "out" / "states").glob("*/*.distcp")
    tensors = (copies - 1) * len(list(network.parameters()))
    stored = (memory.disk - 4 * count) / 3
    assert stored < state.stat().st_size < stored + 3000 * tensors
