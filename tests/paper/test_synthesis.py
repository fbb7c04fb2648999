"""Synthetic scenes are determined by their seeds, differ between seeds, and have room for object and cameras."""

import json
import math
from dataclasses import asdict

import pytest

from splatgraft_paper.synthesis import benchmark, objects, pairs, places
from splatgraft_paper.synthesis.jobs import RenderSize
from splatgraft_paper.synthesis.scene import ARC_LENGTH, camera_arc


@pytest.mark.parametrize("kind", places.KINDS)
def test_same_seed_same_scene_other_seed_other_scene(kind):
    assert places.make_scene(kind, 3) == places.make_scene(kind, 3)
    assert places.make_scene(kind, 3).parts != places.make_scene(kind, 4).parts


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


def test_a_turned_object_stands_as_the_placement_says():
    which = next(scene for scene in benchmark.ROTATIONS if scene.pose_deg == 120)
    target, source = benchmark.plan(which, benchmark.BenchmarkSize(RenderSize(64, 48, 2), 3))
    place, angle = target.scene.places[0], math.radians(which.pose_deg)
    c, s = math.cos(angle), math.sin(angle)
    for before, after in zip(source.objects["object"], target.objects["object"], strict=True):
        x, y = (before.location[i] - place.location[i] for i in range(2))
        turned = (place.location[0] + c * x - s * y, place.location[1] + s * x + c * y)
        assert after.location == pytest.approx((*turned, before.location[2]), abs=1e-9)


def test_plan_renders_each_background_once_and_is_plain_data():
    options = pairs.PairPlan(objects=2, lights=3, size=RenderSize(64, 48, 2))
    for job in (pairs.plan(options, number) for number in range(2)):
        assert [take.name for take in job.takes].count("background") == 1
        assert len(job.cameras) == ARC_LENGTH
        assert len([take for take in job.takes if "_light" in take.name and take.is_pictures]) == 6
        json.dumps(asdict(job.scene))


def test_benchmark_has_the_papers_scenes_and_none_is_a_training_scene():
    kinds = [scene.kind for scene in benchmark.SCENES]
    assert len([kind for kind in kinds if kind in ("terrace", "garden", "square")]) == 3
    assert len(kinds) == 9
    assert sorted({scene.pose_deg for scene in benchmark.ROTATIONS}) == list(benchmark.POSES_DEG)
    trained = {pairs.plan(pairs.PairPlan(), number).scene.name for number in range(8)}
    size = benchmark.BenchmarkSize(RenderSize(64, 48, 2), 8)
    tested = {benchmark.plan(scene, size)[0].scene.name for scene in benchmark.SCENES}
    assert not trained & tested
