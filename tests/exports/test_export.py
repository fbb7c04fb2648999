"""`export`: its input from a scene, a folder or a project; frames, layers, pictures, turntables, and the report."""

import json
import re
from collections import Counter
from dataclasses import replace
from datetime import datetime, timedelta, timezone

import cv2
import numpy as np
import pytest
import torch
from format_files import parts_of_glb, random_gaussians
from PIL import Image
from small_transfer import parts, write_transfer

from splatgraft.cli import main
from splatgraft.core.clock_sun import ClockSun, SunCandidate
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.image_metrics import psnr
from splatgraft.core.similarity import Similarity
from splatgraft.evaluation import Report, ReportView, write_report
from splatgraft.exports.export import ExportOptions, export_scene, layer_of
from splatgraft.exports.export_source import ExportSource, first_view, path_around, upright
from splatgraft.exports.pictures import write_video
from splatgraft.exports.shadow_layer import shadow_layer
from splatgraft.folders.clock_sun import write_clock_sun
from splatgraft.folders.export_source import read_export_source
from splatgraft.formats import SceneMetadata, read_gaussians, read_scene, write_gaussians
from splatgraft.project.placement import ObjectPlacement, Placement, write_placement
from splatgraft.rendering import render


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    return write_transfer(tmp_path_factory.mktemp("transfer"))


@pytest.fixture(scope="module")
def source(project):
    return read_export_source(project)


def same(a: Gaussians, b: Gaussians) -> bool:
    return torch.equal(a.means, b.means) and torch.equal(a.sh, b.sh)


def test_a_project_knows_its_layers_its_frame_and_its_name(source):
    p = parts()
    assert same(layer_of(source, "object")[0], p["relit"])
    assert same(layer_of(source, "scene")[0], p["place"])
    assert same(layer_of(source, "scene-with-shadow")[0], p["shadowed"])
    assert source.pasted is not None
    assert source.pasted.count == source.scene.count == p["place"].count + p["object"].count
    assert source.title == "A ball on a plane"
    assert source.metadata.metres_per_unit == 0.5
    torch.testing.assert_close(torch.tensor(source.metadata.up), torch.tensor([0.0, 0, 1]), atol=1e-3, rtol=0)


def test_its_folders_lead_to_the_project(project):
    for path in (project / "relit", project / "result"):
        assert read_export_source(path).is_object is not None
    # the composite and the target are scenes of their own
    assert same(read_export_source(project / "target/scene").scene, parts()["place"])
    assert read_export_source(project / "target/scene").cameras is not None
    assert read_export_source(project / "composite").is_object is None


def test_erased_gaussians_are_not_in_the_place_and_a_stale_result_is_said(tmp_path, capsys):
    project = write_transfer(tmp_path)
    erased = np.zeros(parts()["place"].count, bool)
    erased[:10] = True
    np.save(project / "composite/erased.npy", erased)
    placement = {"objects": [], "erased": "erased.npy"}
    (project / "composite/placement.json").write_text(json.dumps(placement))
    assert layer_of(read_export_source(project), "scene")[0].count == len(erased) - 10
    (project / "project.toml").write_text('[source]\ncapture = "photos"\n[target]\ncapture = "photos"\n')
    assert read_export_source(project / "project.toml").is_object is not None
    assert main(["export", str(project), "--to", str(project / "a.sog")]) == 0
    assert "out of date" in capsys.readouterr().err


def test_the_first_view_is_a_captured_one_of_the_object(source):
    view, said = first_view(source)
    assert said == ()
    assert source.cameras is not None
    nearest = (source.cameras.centers - torch.tensor(view.center)).norm(dim=1).argmin()
    torch.testing.assert_close(torch.tensor(view.eye), source.cameras.centers[nearest])
    # the median of 80 points on a sphere of radius 0.25 around (0, 0, 0.3)
    assert (torch.tensor(view.center) - torch.tensor([0, 0, 0.3])).norm() < 0.1


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_first_view_and_the_path_begin_on_the_side_that_was_photographed(tmp_path, side):
    project = write_transfer(tmp_path)
    (project / "object").mkdir()
    ball = parts()["object"]
    write_gaussians(project / "object/object.ply", ball)
    np.save(project / "object/is_guessed.npy", (side * ball.means[:, 0] < 0).numpy())
    item = ObjectPlacement(target_from_object=Similarity.identity(), object_path=project / "object/object.ply")
    write_placement(project / "composite/placement.json", Placement(objects=(item,)))
    source = read_export_source(project)
    view, _ = first_view(source)
    assert side * (view.eye[0] - view.center[0]) > 0.3
    first = path_around(source, view, frames=6, width=160).centers[0]
    assert side * (first[0] - view.center[0]) > 0.3
    # flags of another scene are not used
    np.save(project / "object/is_guessed.npy", np.ones(3, bool))
    assert read_export_source(project).photographed_side is None


def test_a_scene_without_cameras_says_what_it_assumes(tmp_path, capsys):
    write_gaussians(tmp_path / "vase.ply", random_gaussians(300, 1))
    assert main(["export", str(tmp_path / "vase.ply"), "--to", str(tmp_path / "vase.html")]) == 0
    assert "the up direction is not known and taken to be -y" in capsys.readouterr().err
    assert "<title>Vase</title>" in (tmp_path / "vase.html").read_text()


@pytest.mark.parametrize("name", ["none", "none.ply", "empty"])
def test_what_is_no_scene_is_one_line(tmp_path, capsys, name):
    (tmp_path / "empty").mkdir()
    assert main(["export", str(tmp_path / name), "--to", str(tmp_path / "a.html")]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert str(tmp_path / name) in said[0]
    assert not (tmp_path / "a.html").exists()


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("a.obj", {}, r"a\.obj: expected a file that ends in \.html, .*found '\.obj'"),
        ("a.sog", {"layer": "object"}, "--layer object: expected the folder of a project"),
        ("a.sog", {"layer": "scene"}, "--layer scene: expected the folder of a project"),
        ("a.sog", {"sh_degree": 4}, "--sh-degree: expected 0 to 3, found 4"),
        ("a.mp4", {"frames": 1}, "--frames: expected 2 or more, found 1"),
        ("a.png", {"width": 8}, "--width: expected 16 pixels or more, found 8"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, name, options, expected):
    with pytest.raises(ValueError, match=expected):
        export_scene(ExportSource(random_gaussians(3), "a"), tmp_path / name, ExportOptions(**options))
    assert list(tmp_path.iterdir()) == []


def test_gaussians_that_are_not_finite_are_left_out_and_said(tmp_path):
    g = random_gaussians(30)
    g.means[4, 1] = float("nan")
    said = export_scene(ExportSource(g, "a"), tmp_path / "a.sog")
    assert said == ("1 Gaussians that are not finite are left out",)
    assert read_gaussians(tmp_path / "a.sog").count == 29


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (0.6, 0, -0.8), (-0.48, 0.6, 0.64)])
def test_up_becomes_minus_y_by_a_rotation(up):
    metadata = SceneMetadata(up=tuple(map(float, up)), metres_per_unit=0.3)
    move, found, said = upright(ExportSource(parts()["place"], "a", metadata=metadata))
    torch.testing.assert_close(move.rotation @ torch.tensor(metadata.up), torch.tensor([0, -1.0, 0]), atol=1e-5, rtol=0)
    torch.testing.assert_close(move.rotation @ move.rotation.T, torch.eye(3), atol=1e-5, rtol=0)
    assert float(torch.linalg.det(move.rotation)) == pytest.approx(1, abs=1e-5)
    assert (move.scale, found.metres_per_unit) == (0.3, 1.0)
    assert "one unit is a metre; one of the capture was 0.3 m" in said


def test_a_glb_is_upright_and_in_metres(project, source, tmp_path, capsys):
    assert main(["export", str(project), "--to", str(tmp_path / "a.glb"), "--layer", "object"]) == 0
    assert "turned upright" in capsys.readouterr().err
    content, _ = parts_of_glb((tmp_path / "a.glb").read_bytes())
    assert content["asset"]["extras"] == {"up": pytest.approx([0, 1, 0]), "metres_per_unit": 1}
    g = read_gaussians(tmp_path / "a.glb")  # back in the axes of a .ply: up is -y
    ball = parts()["relit"]
    # the middle of the ball, 0.3 units above the plane, of 0.5 m each
    assert float(g.means[:, 1].mean()) == pytest.approx(-0.5 * float(ball.means[:, 2].mean()), abs=1e-3)
    torch.testing.assert_close(g.scales, 0.5 * ball.scales, rtol=1e-4, atol=1e-6)
    unknown = replace(source, metadata=replace(source.metadata, metres_per_unit=None))
    said = export_scene(unknown, tmp_path / "b.glb")
    assert any("its size is not known: a unit of the capture is written as a metre" in sentence for sentence in said)


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".compressed.ply"])
def test_others_stay_in_the_frame_of_the_capture(source, tmp_path, suffix):
    export_scene(source, tmp_path / f"a{suffix}", ExportOptions(layer="scene", sh_degree=0))
    found, place = read_gaussians(tmp_path / f"a{suffix}"), parts()["place"]
    # 11 bits of 2 units
    torch.testing.assert_close(found.means.mean(0), place.means.mean(0), atol=1e-3, rtol=0)
    torch.testing.assert_close(found.means.std(0), place.means.std(0), atol=1e-3, rtol=0)
    assert found.sh_degree == 0


def test_the_frame_may_be_chosen(project, tmp_path):
    for frame, suffix in (("world", ".ply"), ("capture", ".glb")):
        out = tmp_path / f"{frame}{suffix}"
        assert main(["export", str(project), "--to", str(out), "--layer", "scene", "--frame", frame]) == 0
    assert read_scene(tmp_path / "world.ply").metadata.up == pytest.approx((0, -1, 0))
    assert read_scene(tmp_path / "world.ply").metadata.metres_per_unit == 1
    assert read_gaussians(tmp_path / "world.ply").means[:, 1].std() < 1e-3  # the plane is level
    captured = read_gaussians(tmp_path / "capture.glb")
    torch.testing.assert_close(captured.means, parts()["place"].means, atol=1e-5, rtol=0)


def test_versions_of_spz(source, tmp_path):
    for version in (3, 4):
        export_scene(source, tmp_path / "a.spz", ExportOptions(spz_version=version))
        assert (tmp_path / "a.spz").read_bytes()[:2] == (b"NG" if version == 4 else b"\x1f\x8b")


def test_the_shadow_over_the_place_is_the_scene_without_its_object(source):
    layer = shadow_layer(source)
    p = parts()
    camera = source.cameras.resized(4.0)[1]  # a size without a fit
    place, scene = (render(p[name], camera).color[0].clamp(0, 1) for name in ("place", "shadowed"))
    drawn = render(layer.gaussians, camera)
    assert float(drawn.color.abs().max()) < 1e-5  # black
    over = place * (1 - drawn.alpha[0][..., None])
    # at most half of the error remains: 144 wide Gaussians cannot draw the shadow's edge better
    assert psnr(over, scene) > psnr(place, scene) + 6
    assert layer.psnr is not None
    assert layer.psnr > psnr(place, scene) + 6


def test_the_object_with_its_shadow_are_both_and_steps_are_counted(source, tmp_path):
    told = []
    both, said = layer_of(source, "object-with-shadow", progress=lambda *counted: told.append(counted))
    relit = parts()["relit"]
    assert torch.equal(both.means[: relit.count], relit.means)
    assert both.count > relit.count
    assert re.search(r"the shadow has \d+ black Gaussians that darken .* \d+\.\d dB PSNR in views outside", said[0])
    assert [one[:2] for one in told] == [(step + 1, len(told)) for step in range(len(told))]


@pytest.mark.parametrize("count", [9, 18])
def test_a_shadow_is_fitted_to_all_views_alike(source, monkeypatch, count):
    """Of 9 cameras 7 are fitted, of 18 cameras 14."""
    assert source.cameras is not None
    seen: Counter[tuple[float, ...]] = Counter()

    def watched(scene, camera, **options):
        if scene.opacity_logits.requires_grad:
            seen[tuple(camera.centers[0].tolist())] += 1
        return render(scene, camera, **options)

    monkeypatch.setattr("splatgraft.exports.shadow_layer.render", watched)
    cameras = path_around(source, first_view(source)[0], frames=count, width=64)
    assert shadow_layer(replace(source, cameras=cameras)).psnr is not None
    assert len(seen) == count - count // 4
    assert max(seen.values()) - min(seen.values()) <= 1


def test_no_shadow_is_said_and_a_shadow_needs_cameras(source):
    p = parts()
    flat = replace(source, scene=concatenate([p["place"], p["relit"]]))
    gaussians, said = layer_of(flat, "shadow")
    assert gaussians.count == 0
    assert said == ("the object casts no shadow that the target's cameras see",)
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
    # it is no wider than the photographs unless an option says so
    assert main([*words[:-4], "--frames", "2"]) == 0
    assert source.cameras is not None
    assert f" of {int(source.cameras.sizes[0, 0])} x " in capsys.readouterr().err


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
    told = []
    options = ExportOptions(frames=4, width=64)
    said = export_scene(source, tmp_path / "a.gif", options, progress=lambda *counted: told.append(counted))
    assert any("0.2 s" in sentence for sentence in said)
    assert [done for done, _, text in told if text == "pictures"] == [0, 1, 2, 3, 4]
    with Image.open(tmp_path / "a.gif") as animation:
        assert animation.n_frames == 4


def test_the_report_is_one_file_with_its_pictures(project, tmp_path, capsys):
    picture = torch.rand(90, 120, 3, generator=torch.Generator().manual_seed(0))
    views = [ReportView(f"v{i}", False, {"Copy-paste": picture, "Result": 1 - picture}) for i in range(3)]
    report = project / "report"
    report.mkdir()
    metrics = {"views": "held out", "view_count": 1, "copy_paste": {"psnr": 20.0}, "result": {"psnr": 24.0}}
    write_report(report, Report("A <report>", "It is one.", metrics=metrics), views=views)
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

    to = str(tmp_path / "c.html")
    (report / "views" / "0001_0.webp").unlink()
    assert main(["export", str(project), "--to", to, "--page", "report"]) == 2
    assert "0001_0.webp: expected a file of the report, found none" in capsys.readouterr().err
    (report / "index.html").unlink()
    assert main(["export", str(project), "--to", to, "--page", "report"]) == 2
    assert "index.html: expected the report of a project, found none" in capsys.readouterr().err
    assert main(["export", str(project), "--to", str(tmp_path / "a.sog"), "--page", "report"]) == 2
    assert "--page report: expected a file that ends in .html, found a.sog" in capsys.readouterr().err


def test_nothing_that_is_exported_tells_when_the_photos_were_taken(tmp_path):
    project = write_transfer(tmp_path)
    time = datetime(2019, 6, 12, 16, 46, tzinfo=timezone(timedelta(hours=-4)))
    sun = ClockSun((SunCandidate(time, "GPS", 44.0, (0.6, 0.0, 0.8)),), (0.0, 0.0, 1.0), 5.0, 5.0, "a track")
    write_clock_sun(project / "target" / "capture", sun)
    (project / "report").mkdir()
    picture = torch.rand(60, 80, 3, generator=torch.Generator().manual_seed(0))
    write_report(project / "report", Report("A report", "It is one."), views=[ReportView("v", False, {"a": picture})])
    for name, page in (("a.html", "viewer"), ("b.html", "report"), ("c.glb", ""), ("d.ply", ""), ("e.png", "")):
        to = tmp_path / name
        assert main(["export", str(project), "--to", str(to), *(["--page", page] if page else [])]) == 0
        content = to.read_bytes()
        assert not [word for word in (b"2019-06-12", b"12 June 2019", b"16:46", b"clock_sun") if word in content]
