"""3DGS .ply and point clouds: bit for bit round trips, layouts of other programs, and refusals in one line."""

import format_files
import numpy as np
import pytest
import torch

from splatgraft import formats
from splatgraft.core.gaussians import empty
from splatgraft.core.spherical_harmonics import rgb_from_dc

BASE = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2")
BASE += ("rot_0", "rot_1", "rot_2", "rot_3")
TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def columns_of(g):
    """Return every field under its .ply name, independently of the writer."""
    out = {"x": g.means[:, 0], "y": g.means[:, 1], "z": g.means[:, 2], "opacity": g.opacity_logits}
    for i in range(3):
        out |= {f"f_dc_{i}": g.sh[:, 0, i], f"scale_{i}": g.log_scales[:, i]}
    for i in range(4):
        out[f"rot_{i}"] = g.quaternions[:, i]
    per_channel = g.sh.shape[1] - 1
    for channel in range(3):
        for band in range(per_channel):
            out[f"f_rest_{channel * per_channel + band}"] = g.sh[:, 1 + band, channel]
    return {name: column.numpy() for name, column in out.items()}


def write(path, columns, *, kind="binary_little_endian", before="", before_data=b"", after="", after_data=b""):
    order = ">" if "big" in kind else "<"
    dtype = np.dtype([(name, column.dtype.newbyteorder(order)) for name, column in columns.items()])
    n = len(next(iter(columns.values())))
    table = np.empty(n, dtype)
    for name, column in columns.items():
        table[name] = column
    lines = "".join(f"property {TYPES[column.dtype.str[1:]]} {name}\n" for name, column in columns.items())
    header = f"ply\nformat {kind} 1.0\ncomment made by a test\n{before}element vertex {n}\n{lines}{after}end_header\n"
    if kind == "ascii":
        data = "".join(" ".join(repr(v.item()) for v in row) + "\n" for row in table).encode()
    else:
        data = table.tobytes()
    path.write_bytes(header.encode() + before_data + data + after_data)


@pytest.mark.parametrize(("n", "degree"), [(0, 1), (1, 0), (6000, 3)])  # 6000 is more than one chunk of the reader
def test_round_trip_is_bit_for_bit(tmp_path, n, degree):
    g = (format_files.random_gaussians(n, degree) if n else empty(degree)).map(
        # any bit pattern: nan with payloads, infinities, denormals among them
        lambda t: torch.from_numpy(np.random.default_rng(t.numel()).integers(0, 2**32, t.shape, "u4").view("f4"))
    )
    formats.write_gaussians(tmp_path / "a.ply", g)
    back = formats.read_gaussians(tmp_path / "a.ply")
    assert format_files.equal(back, g)
    formats.write_gaussians(tmp_path / "b.ply", back)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_written_file_has_the_original_codes_layout(tmp_path):
    g = format_files.random_gaussians(3, 3)
    formats.write_gaussians(tmp_path / "a.ply", g)
    header, data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(45))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    expected = "ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
    assert header.decode() == expected + "".join(f"property float {name}\n" for name in names)
    table = np.frombuffer(data, np.dtype([(name, "<f4") for name in names]))
    for name, column in columns_of(g).items():
        assert (table[name] == column).all(), name


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_any_order_extra_properties_wider_types_and_no_normals(tmp_path, kind):
    g = format_files.random_gaussians(20, 3)
    columns = columns_of(g)
    names = list(columns)
    np.random.default_rng(0).shuffle(names)
    mixed = {name: columns[name] for name in names}
    mixed = {"label": np.arange(20, dtype="i4"), "red": np.zeros(20, "u1"), **mixed, "f_extra": columns["x"]}
    mixed["x"] = mixed["x"].astype("f8")  # wider types become float32
    write(tmp_path / "a.ply", mixed, kind=kind)
    assert format_files.equal(formats.read_gaussians(tmp_path / "a.ply"), g)


def test_other_elements_are_skipped(tmp_path):
    g = format_files.random_gaussians(20, 1)
    for kind, order in (("binary_little_endian", "<"), ("binary_big_endian", ">")):
        face = np.array(3, "u1").tobytes() + np.array([0, 1, 2], order + "i4").tobytes()
        write(
            tmp_path / "a.ply",
            columns_of(g),
            kind=kind,
            before="element view 1\nproperty float focal\n",
            before_data=np.array(1, order + "f4").tobytes(),
            after="element face 2\nproperty list uchar int vertex_indices\n",
            after_data=face * 2,
        )
        assert format_files.equal(formats.read_gaussians(tmp_path / "a.ply"), g)


def test_what_is_not_used_is_named(tmp_path):
    columns = columns_of(format_files.random_gaussians(3, 0))
    write(tmp_path / "a.ply", columns | {"nx": np.zeros(3, "f4"), "red": np.zeros(3, "u1")})
    assert formats.read_scene(tmp_path / "a.ply").notes == ()
    write(tmp_path / "a.ply", columns | {f"semantic_{i}": np.zeros(3, "f4") for i in range(8)})
    (note,) = formats.read_scene(tmp_path / "a.ply").notes
    assert note == "not used: the properties " + ", ".join(f"semantic_{i}" for i in range(6)) + " and 2 more"


def test_windows_line_ends_in_the_header(tmp_path):
    g = format_files.random_gaussians(5, 0)
    formats.write_gaussians(tmp_path / "a.ply", g)
    header, data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    (tmp_path / "a.ply").write_bytes(header.replace(b"\n", b"\r\n") + b"end_header\r\n" + data)
    assert format_files.equal(formats.read_gaussians(tmp_path / "a.ply"), g)


def refusal(path):
    with pytest.raises(ValueError, match="expected") as caught:
        formats.read_gaussians(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: expected ")
    assert "\n" not in message
    return message


def test_point_cloud_is_told_apart_and_missing_properties_are_named(tmp_path):
    formats.write_points(tmp_path / "a.ply", torch.zeros(3, 3), torch.zeros(3, 3))
    assert "point cloud" in refusal(tmp_path / "a.ply")
    columns = columns_of(format_files.random_gaussians(3, 0))
    for missing in ("opacity", "scale_2", "f_dc_0", "y"):
        write(tmp_path / "a.ply", {name: column for name, column in columns.items() if name != missing})
        assert missing in refusal(tmp_path / "a.ply")
    for rest in ([0], range(44), [*range(8), 10], range(72)):
        write(tmp_path / "a.ply", columns | {f"f_rest_{i}": np.zeros(3, "f4") for i in rest})
        assert "f_rest" in refusal(tmp_path / "a.ply")


def test_length_must_be_what_the_header_says(tmp_path):
    formats.write_gaussians(tmp_path / "a.ply", format_files.random_gaussians(30, 2))
    data = (tmp_path / "a.ply").read_bytes()
    for other in (data[:-1], data[:-1000], data + bytes(4)):
        (tmp_path / "a.ply").write_bytes(other)
        assert "bytes" in refusal(tmp_path / "a.ply")


def test_other_files(tmp_path):
    binary = b"ply\nformat binary_little_endian 1.0\nelement vertex "
    for data in (
        b"solid stl",
        binary + b"5\nproperty float x\n",
        b"ply\nformat binary_little_endian 2.0\nend_header\n",
        binary + b"9999999999999\nproperty int x\nend_header\n",
        b"ply\nelement vertex 0\nend_header\n",
    ):
        (tmp_path / "a.ply").write_bytes(data)
        refusal(tmp_path / "a.ply")
    (tmp_path / "a.obj").touch()
    refusal(tmp_path / "a.obj")


def test_points_round_trip(tmp_path):
    points, colors = torch.randn(50, 3), torch.randint(0, 256, (50, 3)).float() / 255
    formats.write_points(tmp_path / "a.ply", points, colors)
    back_points, back_colors = formats.read_points(tmp_path / "a.ply")
    assert torch.equal(back_points, points)
    assert torch.equal(back_colors, colors)


def write_rows(path, rows, *names):
    kinds = [f"property {'uchar' if name in ('red', 'green', 'blue') else 'float'} {name}\n" for name in names]
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{''.join(kinds)}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())
    return path


def test_points_with_normals_without_colour_and_of_gaussians(tmp_path):
    rows = np.zeros(2, [("p", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)])
    rows["p"], rows["c"] = [[1, 2, 3], [4, 5, 6]], [[0, 51, 255], [102, 0, 0]]
    path = write_rows(tmp_path / "a.ply", rows, "x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    points, colors = formats.read_points(path)
    assert points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert torch.allclose(colors, torch.tensor([[0, 0.2, 1], [0.4, 0, 0]]))
    write_rows(path, np.zeros((4, 3), "<f4"), "x", "y", "z")
    assert formats.read_points(path)[1].unique().tolist() == [0.5]
    g = format_files.random_gaussians(9, 2)
    formats.write_gaussians(path, g)
    points, colors = formats.read_points(path)
    assert torch.equal(points, g.means)
    assert torch.equal(colors, rgb_from_dc(g.sh[:, 0]).clamp(0, 1))


def test_positions_must_be_finite_and_float_colours_within_one(tmp_path):
    points = torch.zeros(3, 3)
    points[1, 2] = float("nan")
    formats.write_points(tmp_path / "a.ply", points, torch.zeros(3, 3))
    with pytest.raises(ValueError, match=r"a\.ply: expected finite positions, found 1 of 3"):
        formats.read_points(tmp_path / "a.ply")
    path = write_rows(tmp_path / "a.ply", np.full((2, 6), 200, "<f4"), "x", "y", "z", "f_red", "f_green", "f_blue")
    path.write_bytes(path.read_bytes().replace(b"f_", b""))
    with pytest.raises(ValueError, match="expected colours as bytes"):
        formats.read_points(path)
