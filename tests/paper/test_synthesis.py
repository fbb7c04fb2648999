"""Synthetic scenes are determined by their seeds, differ between seeds, and have room for object and cameras."""

import json
import math

import pytest

from splatgraft_paper.synthesis import benchmark, objects, pairs, places
from splatgraft_paper.synthesis.furniture import placed
from splatgraft_paper.synthesis.jobs import RenderSize, copy_shared_takes
from splatgraft_paper.synthesis.scene import ARC_LENGTH, camera_arc


@pytest.mark.parametrize("kind", places.KINDS)
def test_same_seed_same_scene_other_seed_other_scene(kind):
    assert places.make_scene(kind, 3) == places.make_scene(kind, 3)
    assert places.make_scene(kind, 3).parts != places.make_scene(kind, 4).parts


def test_unknown_kind_is_named():
    with pytest.raises(ValueError, match=r"expected one of living_room.*found 'cellar'"):
        places.make_scene("cellar", 0)


@pytest.mark.parametrize("kind", places.KINDS)
def test_cameras_stay_inside_and_out_of_furniture(kind):
    for seed in range(3):
        scene = places.make_scene(kind, seed)
        low, high = scene.bounds
        for camera in camera_arc(scene, scene.places[0], 0.3, seed):
            assert all(low[i] <= camera.location[i] <= high[i] for i in range(3))
            for a, b in scene.obstacles:
                assert not all(a[i] < camera.location[i] < b[i] for i in range(3))


def test_objects_stand_on_their_place_and_fit_it():
    place = places.make_scene("kitchen", 1).places[0]
    for seed in range(60):
        parts = objects.make(seed, place)
        top = max(p.location[2] + p.size[2] / 2 for p in parts)
        assert 0.05 < top <= place.height
        body = parts[0]
        # a blob's own bottom is a little above that of its box, so it is sunk by 4% of its height
        assert abs(body.location[2] - body.size[2] / 2) <= 0.05 * body.size[2]
        assert body.size[0] / 2 <= place.radius


def test_placed_things_turn_about_the_vertical():
    place = places.make_scene("kitchen", 1).places[0]
    parts = objects.make(5, place)
    moved = placed(parts, (1.0, 2.0, 3.0), 0.7)
    for before, after in zip(parts, moved, strict=True):
        radius = math.hypot(*before.location[:2])
        assert math.hypot(after.location[0] - 1, after.location[1] - 2) == pytest.approx(radius)
        assert after.location[2] == pytest.approx(before.location[2] + 3)


def test_plan_renders_each_background_once_and_is_plain_data():
    options = pairs.PairPlan(scenes=2, objects=2, lights=3, size=RenderSize(64, 48, 2))
    for job in (pairs.plan(options, number) for number in range(2)):
        assert [take.name for take in job.takes].count("background") == 1
        assert len(job.cameras) == ARC_LENGTH
        assert len([take for take in job.takes if "_light" in take.name and take.is_pictures]) == 6
        json.loads(job.scene.to_json())


def test_benchmark_has_the_papers_scenes_and_none_is_a_training_scene():
    kinds = [scene.kind for scene in benchmark.SCENES]
    assert len([kind for kind in kinds if kind in ("terrace", "garden", "square")]) == 3
    assert len(kinds) == 9
    assert sorted({scene.pose_deg for scene in benchmark.ROTATIONS}) == list(benchmark.POSES_DEG)
    trained = {pairs.plan(pairs.PairPlan(), number).scene.name for number in range(8)}
    size = benchmark.BenchmarkSize(RenderSize(64, 48, 2), 8)
    tested = {benchmark.plan(scene, size)[0].scene.name for scene in benchmark.SCENES}
    assert not trained & tested


def rendered_in_name(job, out):
    """Files as a finished job leaves them, each holding its own name."""
    for name in ("cameras.json", "exposure.json"):
        out.mkdir(exist_ok=True)
        (out / name).write_text(name)
    for mark in job.files(out):
        mark.parent.mkdir(exist_ok=True)
        mark.with_suffix(".png").write_text(f"{mark.parent.name} {mark.stem}")
        mark.touch()


def test_rotations_of_one_object_share_the_takes_without_it(tmp_path):
    size = benchmark.BenchmarkSize(RenderSize(64, 48, 2), 8)
    first, other = benchmark.ROTATIONS[0], benchmark.ROTATIONS[1]
    assert other in benchmark.scenes_with_shared_renders(first)
    assert benchmark.SCENES[0] in benchmark.scenes_with_shared_renders(first)
    (target, source), (turned, same) = benchmark.plan(first, size), benchmark.plan(other, size)
    rendered_in_name(target, tmp_path / "target")
    rendered_in_name(source, tmp_path / "source")
    copy_shared_takes(turned, tmp_path / "turned", target, tmp_path / "target")
    assert sorted(path.name for path in (tmp_path / "turned").iterdir() if path.is_dir()) == ["light", "target"]
    assert (tmp_path / "turned" / "target" / "0003.png").read_text() == "target 0003"
    assert not turned.is_done(tmp_path / "turned")
    copy_shared_takes(same, tmp_path / "same", source, tmp_path / "source")
    assert same.is_done(tmp_path / "same")


def test_incomplete_takes_and_those_of_other_scenes_are_not_copied(tmp_path):
    size = benchmark.BenchmarkSize(RenderSize(64, 48, 2), 8)
    target, turned = (benchmark.plan(which, size)[0] for which in benchmark.ROTATIONS[:2])
    stranger = benchmark.plan(benchmark.SCENES[1], size)[0]
    rendered_in_name(target, tmp_path / "target")
    copy_shared_takes(stranger, tmp_path / "stranger", target, tmp_path / "target")
    assert not (tmp_path / "stranger").exists()
    (tmp_path / "target" / "target" / "0003.done").unlink()
    copy_shared_takes(turned, tmp_path / "turned", target, tmp_path / "target")
    assert not (tmp_path / "turned").exists()
