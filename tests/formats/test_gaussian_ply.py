"""3DGS .ply and point clouds: bit for bit round trips, the layouts that programs write, and refusals in one line."""

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
    """Every field under its .ply name, written down independently of the writer."""
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


@pytest.mark.parametrize(("n", "degree"), [(0, 1), (1, 0), (5000, 2)])  # 5000 is more than one chunk of the reader
def test_round_trip_is_bit_for_bit(tmp_path, n, degree):
    g = format_files.random_gaussians(n, degree) if n else empty(degree)
    formats.write_gaussians(tmp_path / "a.ply", g)
    back = formats.read_gaussians(tmp_path / "a.ply")
    assert format_files.equal(back, g)
    formats.write_gaussians(tmp_path / "b.ply", back)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_every_bit_pattern_survives(tmp_path):
    g = format_files.random_gaussians(6000, 3).map(  # nan with payloads, infinities, denormals among them
        lambda t: torch.from_numpy(np.random.default_rng(t.numel()).integers(0, 2**32, t.shape, "u4").view("f4"))
    )
    formats.write_gaussians(tmp_path / "a.ply", g)
    assert format_files.equal(formats.read_gaussians(tmp_path / "a.ply"), g)


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
def test_any_order_extra_properties_and_no_normals(tmp_path, kind):
    g = format_files.random_gaussians(20, 3)
    columns = columns_of(g)
    names = list(columns)
    np.random.default_rng(0).shuffle(names)
    mixed = {name: columns[name] for name in names}
    mixed = {"label": np.arange(20, dtype="i4"), "red": np.zeros(20, "u1"), **mixed, "f_extra": columns["x"]}
    write(tmp_path / "a.ply", mixed, kind=kind)
    assert format_files.equal(formats.read_gaussians(tmp_path / "a.ply"), g)


def test_wider_types_become_float32(tmp_path):
    g = format_files.random_gaussians(20, 1)
    write(tmp_path / "a.ply", {name: column.astype("f8") for name, column in columns_of(g).items()})
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


def test_point_cloud_is_told_apart(tmp_path):
    formats.write_points(tmp_path / "a.ply", torch.zeros(3, 3), torch.zeros(3, 3))
    assert "point cloud" in refusal(tmp_path / "a.ply")


@pytest.mark.parametrize("missing", ["opacity", "scale_2", "f_dc_0", "y"])
def test_missing_property_is_named(tmp_path, missing):
    columns = columns_of(format_files.random_gaussians(3, 0))
    del columns[missing]
    write(tmp_path / "a.ply", columns)
    assert missing in refusal(tmp_path / "a.ply")


@pytest.mark.parametrize("rest", [[0], list(range(44)), [*range(8), 10], list(range(72))])
def test_incomplete_bands_are_refused(tmp_path, rest):
    columns = columns_of(format_files.random_gaussians(3, 0)) | {f"f_rest_{i}": np.zeros(3, "f4") for i in rest}
    write(tmp_path / "a.ply", columns)
    assert "f_rest" in refusal(tmp_path / "a.ply")


@pytest.mark.parametrize("change", [-1, -1000, 4])
def test_length_must_be_what_the_header_says(tmp_path, change):
    formats.write_gaussians(tmp_path / "a.ply", format_files.random_gaussians(30, 2))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data[:change] if change < 0 else data + bytes(change))
    assert "bytes" in refusal(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.ply", b""),
        ("a.ply", b"solid stl"),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\n"),
        ("a.ply", b"ply\nformat binary_little_endian 2.0\nend_header\n"),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 9999999999999\nproperty int x\nend_header\n"),
        ("a.ply", b"ply\nelement vertex 0\nend_header\n"),
        ("a.obj", b""),
    ],
)
def test_other_files(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    refusal(tmp_path / name)
    refusal(tmp_path / "missing.ply")


def test_failed_write_keeps_the_earlier_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    formats.write_gaussians(path, format_files.random_gaussians(3, 0, seed=1))
    before = path.read_bytes()

    def fail(*arguments):
        raise OSError("disk full")

    monkeypatch.setattr(torch, "cat", fail)
    with pytest.raises(OSError, match="disk full"):
        formats.write_gaussians(path, format_files.random_gaussians(3, 0, seed=2))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.ply"]


def test_folder_that_is_not_there(tmp_path):
    with pytest.raises(ValueError, match="expected an existing folder"):
        formats.write_gaussians(tmp_path / "none" / "a.ply", empty())


def test_points_round_trip(tmp_path):
    points, colors = torch.randn(50, 3), torch.randint(0, 256, (50, 3)).float() / 255
    formats.write_points(tmp_path / "a.ply", points, colors)
    back_points, back_colors = formats.read_points(tmp_path / "a.ply")
    assert torch.equal(back_points, points)
    assert torch.equal(back_colors, colors)


def write_rows(path, rows, lines):
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{lines}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())


XYZ = "property float x\nproperty float y\nproperty float z\n"


def test_original_codes_input_with_normals(tmp_path):
    rows = np.zeros(2, [("p", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)])
    rows["p"], rows["c"] = [[1, 2, 3], [4, 5, 6]], [[0, 51, 255], [102, 0, 0]]
    normals = "property float nx\nproperty float ny\nproperty float nz\n"
    write_rows(
        tmp_path / "a.ply", rows, XYZ + normals + "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    )
    points, colors = formats.read_points(tmp_path / "a.ply")
    assert points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert torch.allclose(colors, torch.tensor([[0, 0.2, 1], [0.4, 0, 0]]))


def test_without_colour_is_grey_and_gaussians_give_their_mean_colour(tmp_path):
    write_rows(tmp_path / "a.ply", np.zeros((4, 3), "<f4"), XYZ)
    assert formats.read_points(tmp_path / "a.ply")[1].unique().tolist() == [0.5]
    g = format_files.random_gaussians(9, 2)
    formats.write_gaussians(tmp_path / "g.ply", g)
    points, colors = formats.read_points(tmp_path / "g.ply")
    assert torch.equal(points, g.means)
    assert torch.equal(colors, rgb_from_dc(g.sh[:, 0]).clamp(0, 1))


def test_positions_must_be_finite(tmp_path):
    points = torch.zeros(3, 3)
    points[1, 2] = float("nan")
    formats.write_points(tmp_path / "a.ply", points, torch.zeros(3, 3))
    with pytest.raises(ValueError, match=r"a\.ply: expected finite positions, found 1 of 3"):
        formats.read_points(tmp_path / "a.ply")


def test_float_colours_beyond_one_are_refused(tmp_path):
    rows = np.full((2, 6), 200, "<f4")
    write_rows(tmp_path / "a.ply", rows, XYZ + "property float red\nproperty float green\nproperty float blue\n")
    with pytest.raises(ValueError, match="expected colours as bytes"):
        formats.read_points(tmp_path / "a.ply")
