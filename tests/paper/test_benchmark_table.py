"""The benchmark's numbers: means, intervals, poses, empty columns, FID and KID against their definitions, warping."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch

from splatgraft.core.cameras import Cameras
from splatgraft.evaluation.measure import Truth, find_regions
from splatgraft_paper.benchmark.image_features import frechet_distance, kernel_distance
from splatgraft_paper.benchmark.measure import disagreement, measure_view, only_region, warp
from splatgraft_paper.benchmark.table import Benchmark, Row, as_json, markdown, summaries, summarize, tables


def benchmark(scenes=("a", "b", "c"), **options):
    rows = []
    for i, scene in enumerate(scenes):
        for j, method in enumerate(("copy-paste", "transfer")):
            values = {"psnr_whole": 20.0 + i + 2 * j, "psnr_object": None if i == 1 else 10.0 + j}
            rows.append(Row(scene, method, values, {"relight": 2.0 * j + i}))
    return Benchmark(tuple(rows), (), options.get("missing", {}), ("a note",), options.get("pooled", {}))


def test_means_are_over_scenes_and_a_missing_value_is_no_zero():
    found = summaries(benchmark())
    assert found["transfer"]["psnr_whole"].mean == 23
    assert found["transfer"]["psnr_object"].mean == 11
    assert found["transfer"]["psnr_object"].scenes == 2
    assert found["transfer"]["lpips_whole"] is None


def test_the_interval_holds_the_mean_and_shrinks_to_a_point_for_one_scene():
    values = [1.0, 2.0, 4.0, 9.0]
    found = summarize(values)
    assert min(values) <= found.low < found.mean < found.high <= max(values)
    assert summarize([3.0]).low == summarize([3.0]).high == 3.0
    assert summarize([None, math.nan]) is None
    # the deviation of a mean of n values is theirs over sqrt(n); 1.96 of them on both sides hold 95%
    many = np.random.default_rng(0).normal(size=400)
    wide = summarize(list(many))
    assert abs((wide.high - wide.low) / (2 * 1.96 * many.std() / 20) - 1) < 0.05


def test_a_metric_without_weights_is_said_not_filled():
    text = markdown(benchmark(missing={"lpips": "x.pth: expected weights, found no such file"}))
    row = next(line for line in text.splitlines() if line.startswith("| transfer"))
    assert "not measured" in row
    assert "Not measured: lpips: x.pth" in text
    assert as_json(benchmark())["means"]["transfer"]["lpips_whole"] is None


def test_seconds_are_in_the_cost_table():
    cost = next(table for table in tables(benchmark()) if "Seconds" in table.title)
    assert cost.rows == (("copy-paste", "1.0"), ("transfer", "3.0"))


def test_poses_of_one_scene_are_put_side_by_side():
    scenes = [f"{name}_p{i}" for name in ("hall", "yard") for i in range(3)]
    poses = next(table for table in tables(benchmark(scenes)) if "rotations" in table.title)
    assert [row[0] for row in poses.rows[:3]] == ["copy-paste, P0", "copy-paste, P1", "copy-paste, P2"]
    # scenes 0 and 3 are at P0: 20 and 23
    assert poses.rows[0][1].startswith("21.50")
    assert not any("rotations" in table.title for table in tables(benchmark()))


def test_frechet_distance_is_that_of_its_definition():
    generator = np.random.default_rng(0)
    a, b = generator.normal(size=(40, 6)), generator.normal(0.3, 1.5, size=(50, 6))
    root = scipy.linalg.sqrtm(np.cov(a.T) @ np.cov(b.T)).real
    wanted = ((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(np.cov(a.T) + np.cov(b.T) - 2 * root)
    # both in float64; sqrtm keeps some 10 digits
    assert frechet_distance(a, b) == pytest.approx(wanted, rel=1e-8)
    assert abs(frechet_distance(a, a)) < 1e-8


def test_kernel_distance_is_that_of_its_definition_and_near_zero_for_one_distribution():
    generator = np.random.default_rng(1)
    x, y = generator.normal(size=(8, 5)), generator.normal(1.0, size=(8, 5))

    def kernel(u, v):
        return (u @ v / 5 + 1) ** 3

    within = [np.mean([kernel(u, v) for i, u in enumerate(z) for j, v in enumerate(z) if i != j]) for z in (x, y)]
    between = np.mean([kernel(u, v) for u in x for v in y])
    assert kernel_distance(x, y) == pytest.approx(sum(within) - 2 * between)
    same = kernel_distance(generator.normal(size=(300, 5)), generator.normal(size=(300, 5)))
    assert abs(same) < 0.1 * kernel_distance(generator.normal(size=(300, 5)), generator.normal(1.0, size=(300, 5)))


def truth_view():
    generator = torch.Generator().manual_seed(0)
    background = torch.rand(40, 60, 3, generator=generator) * 0.3 + 0.5
    mask = torch.zeros(40, 60)
    mask[10:25, 10:25] = 1
    image = torch.where(mask[..., None] > 0, torch.full_like(background, 0.3), background)
    image[28:36, 10:30] *= 0.6
    return Truth(image=image, background=background, mask=mask)


def test_an_error_counts_in_its_own_region_only():
    truth = truth_view()
    regions = find_regions(truth)
    for name in ("object", "shadow", "rest"):
        spoilt = torch.where(getattr(regions, name)[..., None], truth.image * 0.5, truth.image)
        found = measure_view(spoilt, truth, background=truth.background)
        for other in ("object", "shadow", "rest"):
            assert (found[f"psnr_{other}"] < 40) == (other == name)
        assert torch.equal(only_region(spoilt, truth, regions, name), spoilt)


def wall_cameras():
    """Return two cameras side by side that look straight at a wall 2 away; 0.1 m between them is 4 px."""
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, 0, 3] = 0.1
    intrinsics = torch.tensor([[80.0, 0, 32], [0, 80.0, 24], [0, 0, 1]]).repeat(2, 1, 1)
    return Cameras(poses, intrinsics, torch.tensor([[64, 48]] * 2), ("0", "1"))


def test_a_wall_seen_from_two_places_is_warped_onto_itself_and_disagrees_by_what_was_added():
    wide = torch.rand(48, 80, 3, generator=torch.Generator().manual_seed(3))
    first, second = wide[:, :64], wide[:, 4:68]
    depth = torch.full((48, 64), 2.0)
    seen, same = warp(second, depth, cameras=wall_cameras(), into_depth=depth)
    assert int(same.sum()) > 48 * 50
    # float32 positions of pixels err by 1e-5 of a pixel
    assert float((seen - first)[same].abs().max()) < 1e-4
    masks = [torch.ones(48, 64)] * 2
    assert disagreement({0: first, 1: second}, [depth, depth], masks, wall_cameras()) < 1e-4
    shifted = disagreement({0: first, 1: second + 0.1}, [depth, depth], masks, wall_cameras())
    assert shifted == pytest.approx(0.1, abs=1e-4)
    assert disagreement({0: first}, [depth, depth], masks, wall_cameras()) is None


def test_what_another_surface_hides_is_not_compared():
    depth, nearer = torch.full((48, 64), 2.0), torch.full((48, 64), 1.0)
    _, same = warp(torch.rand(48, 64, 3), nearer, cameras=wall_cameras(), into_depth=depth)
    assert not bool(same.any())
