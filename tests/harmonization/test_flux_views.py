"""The command `harmonize` with a network: resumed after a kill, in batches, split over processes and over Ray."""

import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch

pytest.importorskip("diffusers")

from tiny_models import CHANNELS, flux_folder, quiet

from splatgraft.cli import main
from splatgraft.commands.steps.harmonize import Harmonize
from splatgraft.core.cameras import Cameras
from splatgraft.core.images import read_rgb
from splatgraft.folders import harmonized_views
from splatgraft.folders.harmonized_views import Part, finished, harmonize_part, picture_folders
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.harmonization import FluxOptions, Harmonized, HarmonizerInputs, NoneOptions
from splatgraft.project.step import perform
from splatgraft.runtime.console import Console

pytestmark = list(quiet)


@pytest.fixture
def views(tmp_path) -> Path:
    names, sizes = ("a", "b", "c", "d"), (32, 32, 16, 32)
    cameras = Cameras(
        world_from_camera=torch.eye(4).repeat(4, 1, 1),
        intrinsics=torch.tensor([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]).repeat(4, 1, 1),
        sizes=torch.tensor([[32, size] for size in sizes]),
        names=tuple(f"images/{name}.png" for name in names),
    )
    folder = ViewFolder.create(tmp_path / "views", cameras)
    g = torch.Generator().manual_seed(0)
    for i, size in enumerate(sizes):
        composite, mask = torch.rand(size, 32, 3, generator=g), torch.zeros(size, 32)
        mask[4:12, 4:20] = 1
        flat = torch.zeros(size, 32, 3)
        folder.write(i, HarmonizerInputs(composite, composite, mask, torch.ones(size, 32), flat, composite))
    return tmp_path / "views"


@pytest.fixture
def weights(tmp_path) -> Path:
    return flux_folder(tmp_path / "image-mask", CHANNELS * 12)


def step(views, weights, out="out", **other) -> Harmonize:
    method = FluxOptions(weights=str(weights), batch=other.pop("batch", 1), seed=other.pop("seed", 0))
    return Harmonize(views, views.parent / out, method, device="cpu", **other)


def images(folder) -> list[bytes]:
    return [path.read_bytes() for path in sorted((folder / "images").iterdir())]


def test_one_option_names_the_method_and_its_weights(views, weights, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["harmonize", "flux", str(views), "--device", "cpu", "--weights", str(weights)]
    assert main(words) == 0
    assert [read_rgb(path).shape for path in sorted((tmp_path / "harmonized" / "images").iterdir())][2] == (16, 32, 3)
    assert "float32 on cpu" in capsys.readouterr().err
    assert main([*words[:-1], str(views)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert "views/config.json: expected the config of a FluxTransformer2DModel, found none" in lines[-1]


def test_the_method_as_an_option_is_understood_and_the_new_form_is_said(views, weights, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["harmonize", str(views), "--method", "reinhard", "--out", "old"]) == 0
    said = capsys.readouterr().err
    assert "--method reinhard is now a sub-command: splatgraft harmonize reinhard VIEWS" in said
    assert main(["harmonize", "reinhard", str(views), "--out", "new"]) == 0
    assert images(tmp_path / "old") == images(tmp_path / "new")
    assert main(["harmonize", str(views), "--method=magic"]) == 2
    assert "--method: expected one of compact, flux" in capsys.readouterr().err


def test_help_of_a_method_shows_its_options_and_no_others(capsys):
    with pytest.raises(SystemExit):
        main(["harmonize", "compact", "--help"])
    shown = capsys.readouterr().out
    for option in ("--out", "--weights", "--strength"):
        assert option in shown
    for option in ("--lora", "--checkout", "--max-cost", "--sampling-steps"):
        assert option not in shown


def test_batches_and_parts_give_the_views_that_one_by_one_gives(views, weights, tmp_path):
    whole = perform(step(views, weights), Console())
    together = perform(step(views, weights, "batch", batch=3), Console())
    for one, other in zip(sorted((whole / "images").iterdir()), sorted((together / "images").iterdir()), strict=True):
        # a level of 8 bits: batched products may round otherwise
        assert (read_rgb(one) - read_rgb(other)).abs().max() <= 1.5 / 255
    (tmp_path / "kept").mkdir()
    picture_folders(tmp_path / "kept")
    for number in range(2):
        harmonize_part(Part(views, FluxOptions(weights=str(weights)), tmp_path / "kept", number, 2, device="cpu"))
        assert finished(tmp_path / "kept", ViewFolder.open(views)) == ({0, 2} if number == 0 else {0, 1, 2, 3})
    assert images(tmp_path / "kept") == images(whole)


def test_a_killed_run_keeps_its_views_and_does_no_more_than_the_rest(views, weights, monkeypatch):
    done = []

    def killed(part, say, progress):
        def counting(count, total, name):
            done.append(name)
            if len(done) == 2:
                raise KeyboardInterrupt

        harmonize_part(part, say, counting)

    monkeypatch.setattr("splatgraft.commands.steps.harmonize.harmonize_part", killed)
    with pytest.raises(KeyboardInterrupt):
        perform(step(views, weights), Console())
    perform(step(views, weights), Console())
    assert done == ["a", "b", "c", "d"]


def test_two_processes_make_the_same_files(views, weights, capsys):
    alone = perform(step(views, weights), Console())
    split = perform(step(views, weights, "split", processes=2), Console())
    assert images(split) == images(alone)
    assert capsys.readouterr().err.count("process 1 of 2 on cpu: 2 views\nprocess 2 of 2 on cpu: 2 views\n") == 1
    with pytest.raises(ValueError, match=r"config.json: expected the config of a FluxTransformer2DModel, found none"):
        perform(step(views, views, "broken", processes=2), Console())


def test_the_machine_does_not_make_a_result_stale(views, weights):
    from splatgraft.project.record import why_stale
    from splatgraft.project.step import job_of

    done = step(views, weights)
    perform(done, Console())
    other_machine = replace(done, method=replace(done.method, batch=4), processes=2, ray="local")
    assert why_stale(job_of(other_machine)) is None
    assert why_stale(job_of(replace(done, method=replace(done.method, seed=1)))) == "seed is now 1, was 0"


def test_workers_of_ray_make_the_same_files(views, weights):
    pytest.importorskip("ray")
    alone = perform(step(views, weights), Console())
    spread = perform(step(views, weights, "spread", processes=2, ray="local"), Console())
    assert images(spread) == images(alone)


class Watched:
    """A harmoniser that works only while the next view is read and the last one is written."""

    def __init__(self, read, written):
        self.read, self.written, self.done = read, written, 0

    def harmonize(self, view):
        later = self.done + 1
        assert later >= len(self.read) or self.read[later].wait(20), "the next view is not read beside the model"
        assert self.done == 0 or self.written[self.done - 1].wait(20), "the last view is not written beside the model"
        self.done += 1
        return Harmonized(view.prior)


def test_files_are_read_and_written_beside_the_model(views, tmp_path, monkeypatch):
    read, written = ([threading.Event() for _ in range(4)] for _ in range(2))
    original, write = ViewFolder.read, harmonized_views._write
    stems = ViewFolder.open(views).stems

    def reading(folder, index):
        view = original(folder, index)
        read[index].set()
        return view

    def writing(kept, stem, result):
        write(kept, stem, result)
        written[stems.index(stem)].set()

    monkeypatch.setattr(ViewFolder, "read", reading)
    monkeypatch.setattr(harmonized_views, "_write", writing)
    monkeypatch.setattr(harmonized_views, "make_harmonizer", lambda options, context: Watched(read, written))
    (tmp_path / "kept").mkdir()
    picture_folders(tmp_path / "kept")
    named = []
    harmonize_part(Part(views, FluxOptions(), tmp_path / "kept", device="cpu"), progress=lambda *w: named.append(w[2]))
    assert named == ["a", "b", "c", "d"]
    assert finished(tmp_path / "kept", ViewFolder.open(views)) == {0, 1, 2, 3}


def test_a_damaged_view_is_one_line_and_those_before_it_are_kept(views, tmp_path):
    (views / "composite" / "c.png").write_bytes(b"no picture")
    (tmp_path / "kept").mkdir()
    picture_folders(tmp_path / "kept")
    with pytest.raises(ValueError, match=r"c.png: expected"):
        harmonize_part(Part(views, NoneOptions(), tmp_path / "kept", device="cpu"))
    assert {0, 1} <= finished(tmp_path / "kept", ViewFolder.open(views))


def test_a_picture_that_cannot_be_written_ends_the_run(views, tmp_path, monkeypatch):
    def full(kept, stem, result):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(harmonized_views, "_write", full)
    (tmp_path / "kept").mkdir()
    picture_folders(tmp_path / "kept")
    with pytest.raises(OSError, match="No space left"):
        harmonize_part(Part(views, NoneOptions(), tmp_path / "kept", device="cpu"))
