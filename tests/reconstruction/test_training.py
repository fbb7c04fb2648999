"""Reconstruction of a tiny scene from its own renders."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from memory_checkpoint import KilledError, MemoryCheckpoint
from shapes import random_scene, same_bits

from splatgraft.core import cameras as camera_values
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.image_metrics import psnr
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.reconstruction import (
    ReconstructOptions,
    describe_duration,
    predict_cpu_seconds,
    predict_memory,
    reconstruct,
)
from splatgraft.reconstruction.initialization import SeedPoints, from_points
from splatgraft.rendering import render

SURROUNDINGS = "splatgraft.reconstruction.training.shows_surroundings"


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> PosedImages:
    """Return sixteen 48x40 views of 150 blobs, with noisy points for them."""
    folder: Path = tmp_path_factory.mktemp("capture")
    truth = random_scene(150, 0, seed=0)
    truth = replace(truth, means=0.6 * truth.means, log_scales=truth.log_scales / 3 - 1, sh=2.5 * truth.sh)
    angle = torch.arange(16) * (2 * torch.pi / 16)
    eye = torch.stack([4 * angle.cos(), 4 * angle.sin(), 1 + (3 * angle).sin()], 1)
    poses = camera_values.look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    cameras = camera_values.pinhole(poses, 50.0, width=48, height=40)
    paths = tuple(folder / f"{i}.png" for i in range(16))
    with torch.no_grad():
        for path, image in zip(paths, render(truth, cameras).color, strict=True):
            write_image(path, image)
    points = truth.means + 0.05 * torch.randn(150, 3, generator=torch.Generator().manual_seed(0))
    return PosedImages(paths, cameras, points, torch.full((150, 3), 0.5))


def held_out_psnr(scene: Gaussians, capture: PosedImages) -> float:
    tested = torch.nonzero(held_out(len(capture))).flatten().tolist()
    with torch.no_grad():
        values = [psnr(render(scene, capture.cameras[i]).color[0].clamp(0, 1), capture.image(i)) for i in tested]
    return float(torch.stack(values).mean())


def test_held_out_views_are_found_again(capture):
    options = ReconstructOptions(iterations=250, budget=300, sh_degree=1, eval_every=8)
    scene = reconstruct(capture, options)
    assert scene.count <= 300
    assert scene.sh_degree == 1
    # black images score about 12 dB here; views between known ones of a scene that Gaussians can express exactly
    # must come far above it, although 48x40 pixels leave the geometry between views open
    assert held_out_psnr(scene, capture) > 20


@pytest.mark.parametrize("more", [False, True], ids=["draft", "with all that standard adds"])
def test_a_killed_reconstruction_resumes_bit_for_bit(capture, monkeypatch, more):
    monkeypatch.setattr("splatgraft.fitting.gaussian_fit._CHECKPOINT_SECONDS", -1.0)
    monkeypatch.setattr(SURROUNDINGS, lambda images, background: True)
    options = ReconstructOptions("standard" if more else "draft", iterations=60, budget=220, sh_degree=1, seed=5)
    whole = reconstruct(capture, options)
    checkpoint = MemoryCheckpoint()

    def die(done: int, total: int, message: str) -> None:
        if total == 60 and done == 30:
            raise KilledError

    with pytest.raises(KilledError):
        reconstruct(capture, options, progress=die, checkpoint=checkpoint)
    assert 0 < checkpoint.state["iteration"] < 60
    assert same_bits(whole, reconstruct(capture, options, checkpoint=checkpoint))


def test_held_out_views_change_nothing(capture, tmp_path):
    options = ReconstructOptions(iterations=12, budget=160, sh_degree=0, eval_every=8)
    write_image(tmp_path / "other.png", torch.rand(40, 48, 3))
    paths = tuple(tmp_path / "other.png" if i % 8 == 0 else p for i, p in enumerate(capture.image_paths))
    assert same_bits(reconstruct(capture, options), reconstruct(replace(capture, image_paths=paths), options))


def watched_counts(capture: PosedImages, budget: int) -> list[float]:
    """Return the numbers of Gaussians in the progress of a short reconstruction, in hundreds."""
    counts = []

    def watch(done: int, total: int, message: str) -> None:
        if "k Gaussians" in message:
            counts.append(float(message.split(", ")[1].split("k", maxsplit=1)[0]) * 1000)

    scene = reconstruct(capture, ReconstructOptions(iterations=60, budget=budget, sh_degree=0), progress=watch)
    return [*counts, scene.count]


def test_the_budget_holds_at_every_moment_and_many_points_leave_room_for_the_density_control(capture):
    assert max(watched_counts(capture, 100)) <= 100
    points = capture.points.repeat(10, 1) + 0.02 * torch.randn(1500, 3, generator=torch.Generator().manual_seed(1))
    counts = watched_counts(replace(capture, points=points, point_colors=torch.full((1500, 3), 0.5)), 1500)
    # at step 10 of 60 a start of 0.6 of the budget has grown by about a tenth of the budget
    assert counts[0] < 1300
    assert counts[-1] > counts[0]


@pytest.fixture
def before_walls(capture, tmp_path) -> PosedImages:
    """Return the blobs inside a large sphere that is dark on one side and bright on the other; no points on it."""
    truth = reconstruct(capture, ReconstructOptions(iterations=1, budget=150, sh_degree=0, quality="draft"))
    direction = torch.nn.functional.normalize(torch.randn(3000, 3, generator=torch.Generator().manual_seed(3)), dim=1)
    shade = (0.05 + 0.6 * (direction[:, :1] > 0)).expand(-1, 3)
    walls = from_points(SeedPoints(30 * direction, shade, torch.full((3000,), torch.inf)))
    walls = replace(walls, opacity_logits=torch.full((3000,), 6.0))
    paths = tuple(tmp_path / f"{i}.png" for i in range(16))
    with torch.no_grad():
        for path, image in zip(paths, render(concatenate([truth, walls]), capture.cameras).color, strict=True):
            write_image(path, image.clamp(0, 1))
    return replace(capture, image_paths=paths)


@pytest.mark.long
@pytest.mark.parametrize("quality", ["draft", "standard"])
def test_walls_behind_the_points_are_shown_to_held_out_views_and_dark_ones_have_no_holes(
    quality, before_walls, monkeypatch
):
    options = ReconstructOptions(quality, iterations=200, budget=1500, sh_degree=0, eval_every=8)
    found = reconstruct(before_walls, options)
    monkeypatch.setattr(SURROUNDINGS, lambda images, background: False)
    without = reconstruct(before_walls, options)
    # a decibel is a fifth of the squared error: walls fill most of these pictures
    assert held_out_psnr(found, before_walls) > held_out_psnr(without, before_walls) + 1
    with torch.no_grad():
        holes = [float(1 - render(scene, before_walls.cameras).alpha.mean()) for scene in (found, without)]
    assert holes[0] < 0.5 * holes[1]


def test_without_points_it_says_so_and_goes_on(capture):
    said = []
    bare = replace(capture, points=torch.zeros(0, 3), point_colors=torch.zeros(0, 3))
    options = ReconstructOptions(iterations=120, budget=300, sh_degree=0, eval_every=8)
    scene = reconstruct(bare, options, progress=lambda done, total, message: said.append(message))
    assert any("no sparse points" in message for message in said)
    # better than the black image (about 12 dB), from pictures alone
    assert held_out_psnr(scene, capture) > 15


def test_images_of_several_sizes_are_fitted_together(capture):
    cameras = capture.cameras
    small, even = cameras.resized(0.75), torch.arange(16)[:, None] % 2 == 0
    sizes = torch.where(even, cameras.sizes, small.sizes)
    mixed = replace(cameras, sizes=sizes, intrinsics=torch.where(even[..., None], cameras.intrinsics, small.intrinsics))
    scene = reconstruct(replace(capture, cameras=mixed), ReconstructOptions(iterations=20, budget=200, sh_degree=0))
    assert torch.isfinite(scene.means).all()


def test_memory_is_asked_for_before_the_start(capture, monkeypatch):
    options = ReconstructOptions(iterations=10, budget=1_000_000)
    assert predict_memory(capture, options) > predict_memory(capture, replace(options, budget=1000))
    monkeypatch.setattr("splatgraft.reconstruction.options.available_memory", lambda device: 10**8)
    with pytest.raises(ValueError, match=r"lower --resolution or --budget \(1000000\)"):
        reconstruct(capture, options)


def test_quality_chooses_what_is_not_given(capture):
    draft, full = ReconstructOptions("draft"), ReconstructOptions("full")
    assert draft.all_iterations == 1000
    assert replace(full, iterations=7).all_iterations == 7
    assert full.max_gaussians > ReconstructOptions().max_gaussians
    durations = [predict_cpu_seconds(capture.cameras, ReconstructOptions(q)) for q in ("draft", "standard", "high")]
    assert durations == sorted(durations)
    assert describe_duration(312.0) == "5 minutes"


def test_large_photographs_are_served_smaller_and_pixels_left_out_where_there_are_more_than_gaussians(capture):
    options = ReconstructOptions(quality="draft")
    large = replace(capture, cameras=capture.cameras.resized(12.0))
    for one, cameras, stride in (
        (options, large.cameras, 2),
        (options, capture.cameras, 1),
        (replace(options, budget=100_000), large.cameras, 1),
    ):
        assert max(part.stride for part in one.sampling(cameras)) == stride
    large = replace(capture, cameras=capture.cameras.resized(40.0))
    assert options.served(large).cameras.width == 640
    assert replace(options, resolution=1.0).served(large).cameras.width == 1920
    assert options.served(capture).cameras.width == 48


def test_too_few_views_and_odd_options_are_named(capture):
    one = capture.select(torch.arange(16) == 0)
    with pytest.raises(ValueError, match="at least 2 views"):
        reconstruct(one, ReconstructOptions(iterations=10))
    with pytest.raises(ValueError, match="eval_every"):
        ReconstructOptions(eval_every=1)
    with pytest.raises(ValueError, match="resolution"):
        ReconstructOptions(resolution=0.0)
