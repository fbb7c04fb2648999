"""Point clouds: round trip, colour types, refusals."""

import format_files
import numpy as np
import pytest
import torch

from splatgraft import formats
from splatgraft.core.spherical_harmonics import rgb_from_dc


def test_round_trip(tmp_path):
    points, colors = torch.randn(50, 3), torch.randint(0, 256, (50, 3)).float() / 255
    formats.write_points(tmp_path / "a.ply", points, colors)
    back_points, back_colors = formats.read_points(tmp_path / "a.ply")
    assert torch.equal(back_points, points)
    assert torch.equal(back_colors, colors)


def write(path, rows, lines):
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{lines}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())


XYZ = "property float x\nproperty float y\nproperty float z\n"


def test_original_codes_input_with_normals(tmp_path):
    rows = np.zeros(2, [("p", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)])
    rows["p"], rows["c"] = [[1, 2, 3], [4, 5, 6]], [[0, 51, 255], [102, 0, 0]]
    normals = "property float nx\nproperty float ny\nproperty float nz\n"
    write(tmp_path / "a.ply", rows, XYZ + normals + "property uchar red\nproperty uchar green\nproperty uchar blue\n")
    points, colors = formats.read_points(tmp_path / "a.ply")
    assert points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert torch.allclose(colors, torch.tensor([[0, 0.2, 1], [0.4, 0, 0]]))


def test_without_colour_is_grey_and_gaussians_give_their_mean_colour(tmp_path):
    write(tmp_path / "a.ply", np.zeros((4, 3), "<f4"), XYZ)
    assert formats.read_points(tmp_path / "a.ply")[1].unique().tolist() == [0.5]
    g = format_files.random_gaussians(9, 2)
    formats.write_gaussians(tmp_path / "g.ply", g)
    points, colors = formats.read_points(tmp_path / "g.ply")
    assert torch.equal(points, g.means)
    assert torch.equal(colors, rgb_from_dc(g.sh[:, 0]).clamp(0, 1))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_positions_must_be_finite(tmp_path, value):
    points = torch.zeros(3, 3)
    points[1, 2] = value
    formats.write_points(tmp_path / "a.ply", points, torch.zeros(3, 3))
    with pytest.raises(ValueError, match=r"a\.ply: expected finite positions, found 1 of 3"):
        formats.read_points(tmp_path / "a.ply")


def test_float_colours_beyond_one_are_refused(tmp_path):
    rows = np.full((2, 6), 200, "<f4")
    write(tmp_path / "a.ply", rows, XYZ + "property float red\nproperty float green\nproperty float blue\n")
    with pytest.raises(ValueError, match="expected colours as bytes"):
        formats.read_points(tmp_path / "a.ply")
