"""The shadow as a layer, pictures with alpha, turntables, and the report as one file."""

import json
import re

import cv2
import numpy as np
import pytest
import torch
from format_files import random_gaussians
from PIL import Image
from small_transfer import parts, write_transfer

from splatgraft.cli import main
from splatgraft.core.gaussians import concatenate
from splatgraft.evaluation import Report, ReportView, write_report
from splatgraft.exports.export import ExportOptions, export_scene, layer_of
from splatgraft.exports.export_source import ExportSource
from splatgraft.exports.first_view import first_view
from splatgraft.exports.shadow_layer import shadow_layer
from splatgraft.exports.turntable_video import path_around, write_video
from splatgraft.folders.export_source import read_export_source
from splatgraft.rendering import render


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    return write_transfer(tmp_path_factory.mktemp("transfer"))


@pytest.fixture(scope="module")
def source(project):
    return read_export_source(project)


def psnr(a, b) -> float:
    return float(-10 * torch.log10((a - b).square().mean()))


def test_the_shadow_over_the_place_is_the_scene_without_its_object(source):
    layer = shadow_layer(source)
    p = parts()
    camera = source.cameras.resized(4.0)[1]  # a size that was not fitted
    place, scene = (render(p[name], camera).color[0].clamp(0, 1) for name in ("place", "shadowed"))
    drawn = render(layer.gaussians, camera)
    assert float(drawn.color.abs().max()) < 1e-5  # black
    over = place * (1 - drawn.alpha[0][..., None])
    # at most half of the error is left: 144 wide Gaussians cannot draw the shadow's edge any better
    assert psnr(over, scene) > psnr(place, scene) + 6
    assert layer.psnr is not None
    assert layer.psnr > psnr(place, scene) + 6


def test_the_object_with_its_shadow_are_both(source):
    shadow, said = layer_of(source, "shadow")
    both, _ = layer_of(source, "object-with-shadow")
    assert torch.equal(both.means, concatenate([parts()["relit"], shadow]).means)
    assert re.search(r"black over what lies behind, of \d+ Gaussians; .* \d+\.\d dB from the scene", said[0])


def test_no_shadow_is_said(source):
    from dataclasses import replace

    p = parts()
    flat = replace(source, scene=concatenate([p["place"], p["relit"]]))
    gaussians, said = layer_of(flat, "shadow")
    assert gaussians.count == 0
    assert said == ("the object casts no shadow that the target's cameras see",)


def test_a_shadow_needs_the_cameras(source):
    from dataclasses import replace

    with pytest.raises(ValueError, match="expected a project with its target's scene and cameras"):
        layer_of(replace(source, cameras=None), "shadow")


def test_a_part_has_alpha_and_straight_colours(project, source, tmp_path):
    for name, layer in (("object.png", "object"), ("all.png", "all")):
        words = ["export", str(project), "--to", str(tmp_path / name), "--layer", layer, "--width", "160"]
        assert main(words) == 0
    with Image.open(tmp_path / "object.png") as picture:
        pixels = np.asarray(picture) / 255
    assert pixels.shape == (120, 160, 4)
    camera = first_view(source)[0].camera(160)
    drawn = render(parts()["relit"], camera)
    assert np.abs(pixels[..., 3] - drawn.alpha[0].numpy()).max() < 1 / 255
    over = pixels[..., :3] * pixels[..., 3:]
    assert np.abs(over - drawn.color[0].clamp(0, 1).numpy()).max() < 2 / 255  # two roundings
    with Image.open(tmp_path / "all.png") as picture:
        assert picture.mode == "RGB"


def frames_of(path):
    video = cv2.VideoCapture(str(path))
    found = []
    while True:
        ok, frame = video.read()
        if not ok:
            return found
        found.append(torch.from_numpy(frame[..., ::-1].copy()).float() / 255)


def test_a_turntable_as_video(project, source, tmp_path, capsys):
    words = ["export", str(project), "--to", str(tmp_path / "a.mp4"), "--frames", "6", "--width", "161"]
    assert main(words) == 0
    assert re.search(r"0\.2 s of 160 x 1\d\d in (VP9|H\.264)", capsys.readouterr().err)
    found = frames_of(tmp_path / "a.mp4")
    assert len(found) == 6
    cameras = path_around(source, first_view(source)[0], frames=6, width=161)
    expected = render(source.scene, cameras[0]).color[0].clamp(0, 1)
    # lossy, and colour at half of the size; frames of the path are below 25 dB apart
    assert psnr(found[0], expected) > 28
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_a_turntable_by_pyav_where_it_is_installed(tmp_path):
    pytest.importorskip("av")
    frames = [torch.full((64, 96, 3), 0.2 + 0.1 * i) for i in range(4)]
    assert write_video(tmp_path / "a.mp4", frames) == "H.264"
    found = frames_of(tmp_path / "a.mp4")
    assert [round(float(frame.mean()), 1) for frame in found] == [0.2, 0.3, 0.4, 0.5]


def test_a_scene_without_cameras_is_circled(tmp_path):
    source = ExportSource(random_gaussians(200, 0), "a")
    view, _ = first_view(source)
    cameras = path_around(source, view, frames=8, width=100)
    torch.testing.assert_close(cameras.centers[0], torch.tensor(view.eye), atol=1e-4, rtol=0)
    distance = (cameras.centers - torch.tensor(view.center)).norm(dim=1)
    torch.testing.assert_close(distance, distance[:1].expand(8), atol=1e-4, rtol=0)
    said = export_scene(source, tmp_path / "a.gif", ExportOptions(frames=4, width=64))
    assert any("0.2 s" in sentence for sentence in said)
    with Image.open(tmp_path / "a.gif") as animation:
        assert animation.n_frames == 4


def test_the_pictures_of_a_turntable_and_a_shadow_s_steps_are_counted(source, tmp_path):
    told = []
    options = ExportOptions(layer="shadow", frames=3, width=32)
    export_scene(source, tmp_path / "a.gif", options, progress=lambda *counted: told.append(counted))
    assert [done for done, _, text in told if text == "pictures"] == [0, 1, 2, 3]
    fitted = [(done, total) for done, total, text in told if text == "fitting the shadow"]
    assert fitted[-1] == (len(fitted), len(fitted))


@pytest.mark.parametrize(("option", "value"), [("--frames", "1"), ("--width", "8")])
def test_numbers_out_of_range(project, tmp_path, capsys, option, value):
    assert main(["export", str(project), "--to", str(tmp_path / "a.mp4"), option, value]) == 2
    assert f"{option}: expected" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def report(project):
    picture = torch.rand(90, 120, 3, generator=torch.Generator().manual_seed(0))
    views = [ReportView(f"v{i}", False, {"Copy-paste": picture, "Result": 1 - picture}) for i in range(3)]
    (project / "report").mkdir(exist_ok=True)
    metrics = {"views": "held out", "view_count": 1, "copy_paste": {"psnr": 20.0}, "result": {"psnr": 24.0}}
    write_report(project / "report", Report("A <report>", "It is one.", metrics=metrics), views=views)
    return project / "report"


def test_the_report_is_one_file_with_its_pictures(project, report, tmp_path):
    for given, name in ((project, "a.html"), (report, "b.html")):
        assert main(["export", str(given), "--to", str(tmp_path / name), "--page", "report"]) == 0
    text = (tmp_path / "a.html").read_text()
    assert text == (tmp_path / "b.html").read_text()
    addresses = re.findall(r'\b(?:src|href)="([^"]*)"', text)
    assert len(addresses) >= 6
    assert all(address.startswith("data:") for address in addresses)
    views = json.loads(re.search(r'id="views">(.*?)</script>', text, re.DOTALL)[1])
    pictures = [address for view in views for address in view["files"].values()]
    assert len(pictures) == 6
    assert all(address.startswith("data:image/webp;base64,") for address in pictures)
    assert 'download="metrics.json"' in text
    assert "loads nothing from the network" in text


def test_a_report_that_is_not_whole(project, report, tmp_path, capsys):
    (report / "views" / "0001_0.webp").unlink()
    assert main(["export", str(project), "--to", str(tmp_path / "a.html"), "--page", "report"]) == 2
    assert "0001_0.webp: expected a file of the report, found none" in capsys.readouterr().err
    (report / "index.html").unlink()
    assert main(["export", str(project), "--to", str(tmp_path / "a.html"), "--page", "report"]) == 2
    assert "index.html: expected the report of a project, found none" in capsys.readouterr().err
    assert main(["export", str(project), "--to", str(tmp_path / "a.sog"), "--page", "report"]) == 2
    assert "--page report: expected a file that ends in .html, found a.sog" in capsys.readouterr().err
