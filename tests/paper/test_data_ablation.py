"""Table 3: the test split of the trainings, refused if it differs, and pictures that outlive a killed run."""

import json
from contextlib import contextmanager

import pytest

pytest.importorskip("diffusers")

from tiny_models import CHANNELS, flux_folder, quiet
from tiny_pairs import relit_folder

from splatgraft.cli import main
from splatgraft.core.images import read_rgb
from splatgraft.runtime.console import Console
from splatgraft_paper.tables.data_ablation import DataAblation, measure_models
from splatgraft_paper.tables.measure_pictures import MetricOptions
from splatgraft_paper.training.pairs import DataOptions, open_relit, read_split, write_split

pytestmark = [*quiet, pytest.mark.filterwarnings("ignore::UserWarning")]
SMALL = ["--size", "32x32", "--batch", "2", "--precision", "no", "--cpu", "--steps", "1", "--validation-pairs", "1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Train for one step on three of four scenes."""
    root = tmp_path_factory.mktemp("trained")
    base, pairs = flux_folder(root / "base"), relit_folder(root / "pairs", 4)
    words = ["paper", "train", "flux", str(root / "out"), "--base", str(base), "--generated", str(pairs)]
    assert main([*words, *SMALL]) == 0
    return root


def ablation(root, out, **models):
    data = DataOptions(generated=(str(root / "pairs"),), size="32x32")
    return DataAblation({"mine": root / "out" / "model", **models}, data, out, MetricOptions(), "cpu")


def test_the_groups_that_were_held_out_are_stored_with_the_weights(trained):
    (split,) = read_split(trained / "out" / "model")["generated"]
    assert len(split["held_out"]) == 1
    assert set(split["held_out"]).isdisjoint(split["trained"])
    assert {*split["held_out"], *split["trained"]} == open_relit(trained / "pairs").groups


def test_the_stored_split_is_measured_even_if_the_data_has_grown(trained, tmp_path):
    found = measure_models(ablation(trained, tmp_path / "a"), Console())
    assert found.notes == ()
    (held_out,) = read_split(trained / "out" / "model")["generated"][0]["held_out"]
    targets = sorted((tmp_path / "a/targets/generated/images").glob("*.png"))
    wanted = [pair.target for pair in open_relit(trained / "pairs").pairs if pair.group == held_out]
    assert [read_rgb(path).tolist() for path in targets] == [read_rgb(path).tolist() for path in wanted]
    # by the hashes of their names, other scenes would be held out of the larger folder
    relit_folder(trained / "grown", 30)
    grown = ablation(trained, tmp_path / "b")
    grown = DataAblation(grown.models, DataOptions(generated=(str(trained / "grown"),), size="32x32"), *(
        tmp_path / "b", MetricOptions(), "cpu"))  # fmt: skip
    assert measure_models(grown, Console()).values == found.values


def test_another_split_is_refused_and_an_unknown_one_is_said(trained, tmp_path):
    others = flux_folder(tmp_path / "others", 12 * CHANNELS, "image-mask")
    found = measure_models(ablation(trained, tmp_path / "a", theirs=others), Console())
    assert found.notes == (f"theirs: {others} has no split.json, so it may have been trained on the test pairs.",)
    (split,) = read_split(trained / "out" / "model")["generated"]
    swapped = {"trained": [*split["trained"][1:], *split["held_out"]], "held_out": split["trained"][:1]}
    write_split(others, {"generated": [swapped]})
    with pytest.raises(ValueError, match=r"held out the same scenes of --generated, found mine and theirs with others"):
        measure_models(ablation(trained, tmp_path / "a", theirs=others), Console())
    write_split(others, {"generated": [{**split, "held_out": ["gone"]}]})
    alone = ablation(trained, tmp_path / "a", mine=others)
    with pytest.raises(ValueError, match=r"pairs: expected the scenes that mine held out, found no gone \(1 of 1"):
        measure_models(alone, Console())
    (others / "split.json").write_text("[3]")
    with pytest.raises(ValueError, match=r"split.json: expected the groups of a training, found IndexError"):
        measure_models(alone, Console())


class Killed(Console):
    """Console whose bar ends the run at the first picture of the second step, the model's."""

    begun = 0

    @contextmanager
    def bar(self, name):
        self.begun += name == "harmonizepictures"

        def move(done, total, message):
            if self.begun == 2:
                raise KeyboardInterrupt

        yield move


def test_a_killed_run_keeps_its_pictures_and_a_finished_one_runs_nothing(trained, tmp_path):
    plain = measure_models(ablation(trained, tmp_path / "plain"), Console())
    with pytest.raises(KeyboardInterrupt):
        measure_models(ablation(trained, tmp_path / "out"), Killed())
    (kept,) = (tmp_path / "out" / "mine" / ".generated.checkpoint" / "images").glob("*.png")
    before = kept.stat().st_mtime_ns
    assert measure_models(ablation(trained, tmp_path / "out"), Console()).values == plain.values
    assert (tmp_path / "out/mine/generated/images" / kept.name).stat().st_mtime_ns == before
    records = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("**/step.json")}
    assert len(records) == 3
    assert all(json.loads(path.read_text()) for path in records)
    measure_models(ablation(trained, tmp_path / "out"), Console())
    assert {path: path.stat().st_mtime_ns for path in records} == records
