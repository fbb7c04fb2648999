"""A sample of a scene is rows of its file, read without torch."""

from pathlib import Path

import numpy as np
import pytest
import torch
from shapes import ring

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.spherical_harmonics import C0
from splatgraft.editor.scene_sample import read_first_view, read_sample, sample_count
from splatgraft.formats import write_cameras, write_gaussians


def random_gaussians(n: int, sh_degree: int) -> Gaussians:
    generator = torch.Generator().manual_seed(n)

    def numbers(*shape: int) -> torch.Tensor:
        return torch.randn(n, *shape, generator=generator)

    return Gaussians(numbers(3), numbers(3) - 3, numbers(4), numbers(), 0.3 * numbers((sh_degree + 1) ** 2, 3))


def test_a_sample_is_some_rows_of_the_file(tmp_path: Path) -> None:
    scene = random_gaussians(1000, sh_degree=2)
    write_gaussians(tmp_path / "scene.ply", scene)
    sample = read_sample(tmp_path / "scene.ply", most=90)
    assert sample is not None
    assert sample.total == sample_count(tmp_path / "scene.ply") == 1000
    assert len(sample.rows) == 90
    rows = torch.from_numpy(sample.rows.copy())
    # spread over the whole file
    assert int(rows.diff().max()) <= 12
    assert int(rows[0]) == 0
    assert int(rows[-1]) > 980
    for found, whole in (
        (sample.means, scene.means),
        (sample.quaternions, scene.quaternions),
        (sample.opacity_logits, scene.opacity_logits),
        (sample.band_0, scene.sh[:, 0]),
    ):
        assert np.array_equal(found, whole[rows].numpy())
    assert np.allclose(sample.colors, (0.5 + C0 * scene.sh[rows, 0]).clamp(0, 1).numpy(), atol=1e-6)
    # enlarged by the same factor along all axes, which is no less than 1 and grows no Gaussian beyond the largest
    growth = sample.log_scales - scene.log_scales[rows].numpy()
    assert growth.min() >= 0
    assert np.ptp(growth, axis=1).max() < 1e-5
    assert float(np.median(growth)) > 0.5
    erased = np.zeros(1000, bool)
    erased[sample.rows[:30]] = True
    assert np.array_equal(sample.without(erased).rows, sample.rows[30:])
    assert sample.without(erased[:-1]) is sample


def test_a_small_scene_is_its_own_sample(tmp_path: Path) -> None:
    scene = random_gaussians(50, sh_degree=0)
    write_gaussians(tmp_path / "scene.ply", scene)
    sample = read_sample(tmp_path / "scene.ply")
    assert sample is not None
    assert np.array_equal(sample.log_scales, scene.log_scales.numpy())
    assert np.array_equal(sample.means, scene.means.numpy())


def test_files_of_other_layouts_have_no_sample(tmp_path: Path) -> None:
    scene = random_gaussians(600, sh_degree=0)
    write_gaussians(tmp_path / "scene.ply", scene)
    write_gaussians(tmp_path / "scene.compressed.ply", scene)
    write_gaussians(tmp_path / "scene.spz", scene)
    whole = (tmp_path / "scene.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[:-5])
    (tmp_path / "none.ply").write_bytes(whole.replace(b"vertex 600", b"vertex 0").partition(b"end_header\n")[0])
    (tmp_path / "ascii.ply").write_bytes(whole.replace(b"binary_little_endian", b"ascii"))
    (tmp_path / "empty.ply").write_bytes(b"")
    for name in ("scene.compressed.ply", "scene.spz", "cut.ply", "none.ply", "ascii.ply", "empty.ply", "missing.ply"):
        assert read_sample(tmp_path / name) is None, name
    # Gaussians that no renderer draws are left out
    broken = scene.map(torch.clone)
    broken.means[0, 0], broken.quaternions[1] = torch.nan, 0.0
    write_gaussians(tmp_path / "broken.ply", broken)
    sample = read_sample(tmp_path / "broken.ply")
    assert sample is not None
    assert sample.rows[0] == 2


def test_the_first_view_is_through_the_first_camera(tmp_path: Path) -> None:
    cameras = ring(3, height=1.0, size=(320, 200))
    poses, eyes = cameras.world_from_camera, cameras.centers
    write_cameras(tmp_path / "transforms.json", cameras)
    view = read_first_view(tmp_path / "transforms.json")
    assert view is not None
    # what float32 holds of numbers near 3
    assert np.allclose(view.position, eyes[0], atol=1e-6)
    towards = (view.look_at - view.position) / np.linalg.norm(view.look_at - view.position)
    assert np.allclose(towards, -eyes[0] / eyes[0].norm(), atol=1e-6)
    assert np.allclose(view.up, -poses[0, :3, 1], atol=1e-6)
    assert view.half_height == pytest.approx(100 / float(cameras.intrinsics[0, 1, 1]))
    assert view.aspect == pytest.approx(1.6)
    for text in ("", "{}", '{"frames": []}', "[1]", '{"frames": [{"transform_matrix": [[1]]}], "w": 1, "h": 1}'):
        (tmp_path / "transforms.json").write_text(text)
        assert read_first_view(tmp_path / "transforms.json") is None
