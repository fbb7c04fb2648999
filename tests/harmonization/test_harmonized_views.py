"""Folders of harmonised views: resumed after a kill, in batches, split over processes and over Ray."""

import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splatgraft.cli import main
from splatgraft.core.cameras import Cameras
from splatgraft.core.images import read_rgb
from splatgraft.folders import harmonized_views
from splatgraft.folders.harmonized_views import Part, finished, harmonize_part
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.harmonization import FluxOptions, HarmonizerInputs, NoneOptions
from splatgraft.project.record import why_stale
from splatgraft.project.step import job_of, perform
from splatgraft.runtime.console import Console
from splatgraft.steps.harmonize import Harmonize


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
        folder.write(i, HarmonizerInputs(composite, composite, mask, torch.ones(size, 32), 0.8 * composite))
    return tmp_path / "views"


@pytest.fixture
def kept(tmp_path) -> Path:
    (tmp_path / "kept" / "images").mkdir(parents=True)
    return tmp_path / "kept"


def step(views, out="out", method=NoneOptions(), **other) -> Harmonize:
    return Harmonize(views, views.parent / out, method, device="cpu", **other)


def images(folder) -> list[bytes]:
    return [path.read_bytes() for path in sorted((folder / "images").iterdir())]


def test_the_method_is_a_sub_command(views, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["harmonize", "none", str(views), "--out", "new"]) == 0
    assert [read_rgb(path).shape for path in sorted((tmp_path / "new" / "images").iterdir())][2] == (16, 32, 3)
    assert main(["harmonize", "edit", str(views)]) == 2
    assert "harmonizer edit: expected --model FOLDER or a hub id" in capsys.readouterr().err


def test_help_of_a_method_shows_its_options_and_no_others(capsys):
    with pytest.raises(SystemExit):
        main(["harmonize", "edit", "--help"])
    shown = capsys.readouterr().out
    for option in ("--out", "--model", "--sampling-steps"):
        assert option in shown
    for option in ("--lora", "--checkout", "--max-cost", "--precision"):
        assert option not in shown


def test_parts_give_the_views_that_the_whole_gives(views, kept):
    whole = perform(step(views), Console())
    for number in range(2):
        assert harmonize_part(Part(views, NoneOptions(), kept, number, 2, device="cpu")) == 2
        assert finished(kept, ViewFolder.open(views)) == ({0, 2} if number == 0 else {0, 1, 2, 3})
    assert images(kept) == images(whole)


def test_a_killed_run_keeps_its_views_and_does_no_more_than_the_rest(views, monkeypatch):
    done = []

    def killed(part, say, progress):
        def counting(count, total, name):
            done.append(name)
            if len(done) == 2:
                raise KeyboardInterrupt

        harmonize_part(part, say, counting)

    monkeypatch.setattr("splatgraft.steps.harmonize.harmonize_part", killed)
    with pytest.raises(KeyboardInterrupt):
        perform(step(views), Console())
    perform(step(views), Console())
    assert done == ["a", "b", "c", "d"]


@pytest.mark.long
def test_two_processes_make_the_same_files(views, capsys):
    alone = perform(step(views), Console())
    split = perform(step(views, "split", processes=2), Console())
    assert images(split) == images(alone)
    assert "process 1 of 2 on cpu: 2 views\nprocess 2 of 2 on cpu: 2 views\n" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"harmonizer flux: expected --weights FOLDER or dot3d"):
        perform(step(views, "broken", FluxOptions(), processes=2), Console())


@pytest.mark.long
def test_workers_of_ray_make_the_same_files(views):
    pytest.importorskip("ray")
    alone = perform(step(views), Console())
    assert images(perform(step(views, "spread", processes=2, ray="local"), Console())) == images(alone)


def test_the_machine_does_not_make_a_result_stale(views):
    done = step(views)
    perform(done, Console())
    assert why_stale(job_of(replace(done, processes=2, ray="local"))) is None
    assert why_stale(job_of(replace(done, method=FluxOptions()))) == "method is now flux, was none"


class Watched:
    """Harmoniser and its own options; it works only while the next view is read and the last one is written."""

    name = "watched"

    def __init__(self, read, written):
        self.read, self.written, self.done = read, written, 0

    def make(self, context):
        return self

    def harmonize(self, view):
        later = self.done + 1
        assert later >= len(self.read) or self.read[later].wait(20), "the next view is not read beside the model"
        assert self.done == 0 or self.written[self.done - 1].wait(20), "the last view is not written beside the model"
        self.done += 1
        return view.prior


def test_files_are_read_and_written_beside_the_model(views, kept, monkeypatch):
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
    named = []
    harmonize_part(Part(views, Watched(read, written), kept, device="cpu"), progress=lambda *w: named.append(w[2]))
    assert named == ["a", "b", "c", "d"]
    assert finished(kept, ViewFolder.open(views)) == {0, 1, 2, 3}


def test_a_damaged_view_is_one_line_and_those_before_it_are_kept(views, kept):
    (views / "composite" / "c.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"c.png: expected"):
        harmonize_part(Part(views, NoneOptions(), kept, device="cpu"))
    assert {0, 1} <= finished(kept, ViewFolder.open(views))


def test_a_picture_that_cannot_be_written_ends_the_run(views, kept, monkeypatch):
    def full(kept, stem, result):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(harmonized_views, "_write", full)
    with pytest.raises(OSError, match="No space left"):
        harmonize_part(Part(views, NoneOptions(), kept, device="cpu"))
