"""Staleness, replacement of results, locks and checkpoints, for runs that are killed, repeated or started twice."""

import os
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from killing import Killed, killed_at_write

from splatgraft.project.record import Job, read_record, why_stale
from splatgraft.project.step import FolderCheckpoint, locked, plain_options, replacing
from splatgraft.runtime.files import atomic_folder
from splatgraft.segmentation import SolidifyOptions


def job(folder: Path, files: tuple[Path, ...] = (), **options: object) -> Job:
    return Job(step="step", folder=folder, inputs={"images": files}, options=options)


def finish(wanted: Job, text: str = "result") -> None:
    with replacing(wanted) as folder:
        (folder / "scene.ply").write_text(text)


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "a.png"
    path.write_text("pixels")
    return path


def test_a_finished_result_is_fresh_and_says_how_it_was_made(tmp_path: Path, image: Path) -> None:
    wanted = job(tmp_path / "scene", (image,), iterations=7, size=(1, 2))
    assert why_stale(wanted) == "not made yet"
    finish(wanted)
    assert why_stale(wanted) is None
    record = read_record(tmp_path / "scene")
    assert record is not None
    assert record.outputs == ("scene.ply",)
    assert record.options == {"iterations": 7, "size": [1, 2]}
    assert record.seconds >= 0
    assert record.peak_memory_bytes > 0


def test_only_content_and_options_make_stale(tmp_path: Path, image: Path) -> None:
    folder = tmp_path / "scene"
    finish(job(folder, (image,), iterations=7))
    os.utime(image, (0, 0))
    assert why_stale(job(folder, (image,), iterations=7)) is None
    assert why_stale(job(folder, (image,), iterations=8)) == "iterations is now 8, was 7"
    assert why_stale(job(folder, (), iterations=7)) == "images: 0 files, was 1"
    image.write_text("other!")
    assert why_stale(job(folder, (image,), iterations=7)) == "images: a.png changed"
    (folder / "scene.ply").unlink()
    assert why_stale(job(folder, (image,), iterations=7)) == "scene.ply was removed"


def test_files_of_many_gigabytes_are_compared_by_size_and_time(tmp_path: Path) -> None:
    weights = tmp_path / "model.safetensors"
    with weights.open("wb") as stream:
        stream.truncate(5 << 30)  # a sparse file, which takes no room
    finish(job(tmp_path / "scene", (weights,)))
    assert why_stale(job(tmp_path / "scene", (weights,))) is None
    os.utime(weights, (0, 0))
    assert why_stale(job(tmp_path / "scene", (weights,))) == "images: model.safetensors changed"


def test_options_of_nested_settings_are_keys_beside_the_others_without_paths_and_machine(tmp_path: Path) -> None:
    nested = SolidifyOptions(iterations=7)
    found = plain_options({"out": tmp_path, "device": "cuda", "point": (1.0, 2.0), "solidify": nested})
    assert found == {"point": [1.0, 2.0], **vars(nested)}


def test_fingerprint_moves_with_inputs_and_options(tmp_path: Path, image: Path) -> None:
    names = {one.fingerprint for one in (job(tmp_path, (image,)), job(tmp_path, (image,), a=1), job(tmp_path))}
    image.write_text("changed")
    assert len(names | {job(tmp_path, (image,)).fingerprint}) == 4


def test_files_that_no_step_wrote_are_never_replaced(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.jpg").write_text("dear")
    with (
        pytest.raises(ValueError, match=r"photos: expected no folder or one that a step wrote"),
        replacing(job(photos)),
    ):
        pass
    with pytest.raises(ValueError, match=r"a.jpg: expected a folder for the result"), replacing(job(photos / "a.jpg")):
        pass
    assert (photos / "a.jpg").read_text() == "dear"


def test_missing_input_and_damaged_record_are_told_by_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"gone.png: expected an input file, found No such file"):
        FolderCheckpoint(job(tmp_path / "scene", (tmp_path / "gone.png",)))
    finish(job(tmp_path / "scene"))
    for damaged in ("{", "[]", "{}", '{"inputs": 3}'):
        (tmp_path / "scene" / "step.json").write_text(damaged)
        with pytest.raises(ValueError, match=r"step.json: expected the record of a step, found"):
            why_stale(job(tmp_path / "scene"))


def test_killed_at_any_write_the_folder_holds_one_whole_result(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    states = set()
    for writes in range(200):
        finish(job(scene), "earlier")
        survived = False
        with suppress(Killed), killed_at_write(writes):
            with replacing(job(scene)) as folder:
                (folder / "scene.ply").write_text("later")
                (folder / "points.ply").write_text("later")
            survived = True
        texts = {path.name: path.read_text() for path in scene.glob("*.ply")}
        assert texts in ({"scene.ply": "earlier"}, {"scene.ply": "later", "points.ply": "later"})
        assert read_record(scene) is not None
        states.add((survived, texts["scene.ply"]))
        finish(job(scene), "after")
        assert [p.name for p in tmp_path.iterdir()] == ["scene"]
        if survived:
            break
    # the loop ran past the last write, and some kills came before and some after the swap
    assert states == {(True, "later"), (False, "earlier"), (False, "later")}


def test_what_a_kill_between_two_renames_left_is_put_back(tmp_path: Path) -> None:
    (tmp_path / ".scene.old").mkdir()
    (tmp_path / ".scene.old" / "scene.ply").write_text("earlier")
    with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "scene"):
        raise KeyboardInterrupt
    assert (tmp_path / "scene" / "scene.ply").read_text() == "earlier"


def test_one_run_at_a_time(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    with locked(tmp_path / "scene"):
        with pytest.raises(ValueError, match=r"scene: expected no other run at work here"), locked(tmp_path / "scene"):
            pass
        # another folder is free
        with locked(tmp_path / "other"):
            pass
    with locked(tmp_path / "scene"):
        pass


def test_checkpoint_lives_for_its_own_job_only(tmp_path: Path) -> None:
    wanted = job(tmp_path / "scene", iterations=7)
    assert FolderCheckpoint(wanted).load() is None
    FolderCheckpoint(wanted).save({"step": 3, "means": torch.arange(3.0), "nested": {"a": [1, 2.5]}})
    state = FolderCheckpoint(wanted).load()
    assert state is not None
    assert state["step"] == 3
    assert torch.equal(state["means"], torch.arange(3.0))
    assert FolderCheckpoint(job(tmp_path / "scene", iterations=8)).load() is None
    assert FolderCheckpoint(wanted).load() is None
