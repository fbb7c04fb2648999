"""Structure from motion: helpful errors, doubtful figures, and photos with known true poses."""

import math
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from made_captures import colmap_answer
from made_up_photos import similarity_to, texture
from PIL import Image
from PIL.ExifTags import IFD, Base

from splatgraft.capture import PoseOptions, pose_photos, read_doubts, structure_from_motion, write_pose_report
from splatgraft.capture.photo_inspection import find_in_coverage
from splatgraft.capture.photos import camera_groups, working_copies
from splatgraft.capture.pose_report import Doubt, Lens, PoseReport, Unposed, find_doubts
from splatgraft.capture.structure_from_motion import upright
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.images import write_image
from splatgraft.core.planes import dominant_level_plane
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.core.similarity import Similarity
from splatgraft.formats import read_capture
from splatgraft.formats.captures.masks import PhotoFiles, find_photos

UP = torch.tensor([0.0, 0, 1])
BANANAS = Path(__file__).parents[2] / "src" / "splatgraft" / "demo_captures" / "bananas"
needs_colmap = pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is an optional extra")


def pose(photos, folder, **more):
    return pose_photos(photos, folder, scratch=folder / "scratch", **more)


def photo_paths(folder, count):
    folder.mkdir(parents=True, exist_ok=True)
    generator = torch.Generator().manual_seed(0)
    paths = [folder / f"{i:02d}.png" for i in range(count)]
    for path in paths:
        write_image(path, torch.rand(30, 40, 3, generator=generator))
    return PhotoFiles(tuple(paths))


def left_half(folder):
    """Write a mask of the left half of a photo."""
    write_image(folder / "mask.png", (torch.arange(40) < 20).float().expand(30, 40))
    return folder / "mask.png"


def circle(count, height=1.0):
    angle = torch.arange(count) * (2 * math.pi / max(count, 1))
    eye = torch.stack([2 * angle.cos(), 2 * angle.sin(), height + 0.2 * (3 * angle).sin()], -1)
    return look_at(eye, torch.zeros(3), UP)


def model_of(posed, photos):
    """Return the answer of the COLMAP process with this number of posed photos."""
    rows = [{"name": f"{i:02d}.jpg", "features": 900, "matches": 12, "moved": False} for i in range(photos)]
    return colmap_answer([f"{i:02d}.jpg" for i in range(posed)], circle(posed), (40, 30), photos=rows)


@pytest.fixture
def answer(monkeypatch):
    """Replace COLMAP's models by given ones."""
    monkeypatch.setattr(structure_from_motion, "find_spec", lambda name: object())

    def give(*models):
        queue = list(models)
        monkeypatch.setattr(structure_from_motion, "_run", lambda job, advance, say: queue.pop(0))
        return queue

    return give


def test_what_cannot_be_posed_is_said(tmp_path, answer, monkeypatch):
    answer(model_of(2, 8), model_of(3, 8))
    with pytest.raises(ValueError, match=r"half of 8 photos to register, found 3; take more photos"):
        pose(photo_paths(tmp_path / "photos", 8), tmp_path)
    photos = photo_paths(tmp_path / "photos", 3)
    with pytest.raises(ValueError, match="at least 3 photos"):
        pose(PhotoFiles(photos.paths[:2]), tmp_path)
    with pytest.raises(ValueError, match="one photo per name"):
        pose(PhotoFiles(photos.paths + photo_paths(tmp_path / "b", 1).paths), tmp_path)
    write_image(tmp_path / "mask.png", torch.zeros(40, 40, 3))
    with pytest.raises(ValueError, match=r"mask\.png: expected 40x30 px.*found 40x40"):
        pose(replace(photos, masks=(None, tmp_path / "mask.png", None)), tmp_path)
    photos.paths[1].write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"01\.png"):
        pose(photos, tmp_path)
    monkeypatch.setattr(structure_from_motion, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"splatgraft\[sfm\]"):
        pose(photos, tmp_path)


def test_where_less_than_half_is_posed_all_is_done_once_more_and_the_better_model_is_taken_and_reported(
    tmp_path, answer
):
    said: list[str] = []
    answer(model_of(3, 8) | {"seconds": {"features": 20.0, "mapping": 10.0}}, model_of(7, 8))
    posed, report = pose(photo_paths(tmp_path / "photos", 8), tmp_path, say=said.append)
    assert "took 30 s (features 20, mapping 10)" in said[0]
    assert "only 3 of 8 photos got a pose: structure from motion runs again with more features" in said[1]
    assert "about 20 min" in said[1]
    assert (report.registered, report.photos, report.missing) == (7, 8, (Unposed("07", 900, 12),))
    assert "7 of 8 photos have a pose" in str(report)
    assert "without a pose: 1 (07: another place, or too far from the next photo)" in str(report)
    assert len(posed) == 7
    assert posed.image(0).shape == (30, 40, 3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["images", "photos", "scratch"]


def test_a_photo_of_the_moved_object_is_left_out_and_named(tmp_path, answer):
    moved = {"name": "07.jpg", "features": 900, "matches": 400, "moved": True}
    answer(model_of(7, 7) | {"photos": [moved]})
    posed, report = pose(photo_paths(tmp_path / "photos", 8), tmp_path)
    assert len(posed) == 7
    assert report.missing == (Unposed("07", 900, 400, moved=True),)
    assert "1 (07: the object was moved or turned against its surroundings)" in str(report)


def ring_with_two_past(kind):
    """Return the answer for 14 photos of a ring, of which 05 and 06 look 40 degrees past its middle.

    Each photo has 200 matches with the next two. If the poses are right, one pair of 05 has 60 false matches instead.
    """
    poses, names = circle(14), [f"{i:02d}.jpg" for i in range(14)]
    angle = math.radians(40)
    aside = torch.tensor([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    poses[5:7, :3, :3] @= aside
    if kind == "all look outwards":
        poses[:, :3, :3] @= torch.diag(torch.tensor([-1.0, 1, -1]))
    rows = [[names[i], names[(i + step) % 14], 200, 1.0] for i in range(14) for step in (1, 2)]
    for row in rows:
        if len({"05.jpg", "06.jpg"} & {*row[:2]}) == 1 and kind != "turned away":
            row[3] = 0.0
    if kind == "turned away":
        rows = [row for row in rows if "05.jpg" not in row or "06.jpg" in row] + [["04.jpg", "05.jpg", 60, 0.0]]
    return colmap_answer(names, poses, (40, 30), agreements=rows)


def test_photos_that_miss_the_point_of_the_others_and_contradict_their_matches_are_left_out_and_named(tmp_path, answer):
    answer(ring_with_two_past("posed wrongly"))
    posed, report = pose(photo_paths(tmp_path / "photos", 14), tmp_path)
    assert [f"{i:02d}.jpg" for i in range(14) if i not in (5, 6)] == list(posed.cameras.names)
    assert [(one.name, one.astray) for one in report.missing] == [("05", True), ("06", True)]
    assert "2 (05, 06: its pose contradicts its matches, and it does not show what the others look at)" in str(report)


@pytest.mark.parametrize("kind", ["turned away", "all look outwards"])
def test_a_camera_that_was_turned_away_stays_and_so_do_all_without_a_common_point(tmp_path, answer, kind):
    answer(ring_with_two_past(kind))
    posed, report = pose(photo_paths(tmp_path / "photos", 14), tmp_path)
    assert (len(posed), report.missing) == (14, ())
    told = find_in_coverage(posed.cameras).text
    assert ("2 do not show it: 05.jpg, 06.jpg" in told) == (kind == "turned away")


def test_what_a_pass_posed_is_a_result_and_more_is_offered_with_its_time(tmp_path, answer):
    said: list[str] = []
    left = answer(model_of(5, 8) | {"seconds": {"mapping": 30.0}}, model_of(8, 8))
    _, report = pose(photo_paths(tmp_path / "photos", 8), tmp_path, say=said.append)
    assert len(left) == 1
    assert report.registered == 5
    assert [one.name for one in report.missing] == ["05", "06", "07"]
    assert "photos with a pose: expected at least 70%, found 5 of 8" in said[1]
    assert 'effort = "thorough" finds more features, in about 20 min' in said[1]


def test_a_full_quick_model_needs_no_second_effort_and_masks_are_undistorted_like_photos(tmp_path, answer):
    left = answer(model_of(3, 3), model_of(3, 3))
    photos, mask = photo_paths(tmp_path / "photos", 3), left_half(tmp_path)
    posed, _ = pose(replace(photos, masks=(None, mask, None)), tmp_path)
    assert len(left) == 1
    assert [path and path.relative_to(tmp_path).as_posix() for path in posed.mask_paths] == [None, "masks/01.png", None]
    carried = posed.mask(1)
    assert carried.shape == posed.image(1).shape[:2]
    # the middle column stays, because the principal point is in the middle
    assert carried[:, :19].min() == 1
    assert carried[:, 21:].max() == 0


def test_photos_on_their_side_are_turned_with_their_masks_and_that_is_said(tmp_path, answer):
    count = 12
    upright_ones = pinhole(circle(count), 50.0, width=40, height=30)
    lying = upright_ones.turned(torch.ones(count, dtype=torch.long))
    answer(colmap_answer([f"{i:02d}.jpg" for i in range(count)], lying.world_from_camera, (40, 30)))
    photos, said = photo_paths(tmp_path / "photos", count), []
    masks = (left_half(tmp_path), *[None] * (count - 1))
    posed, _ = pose(replace(photos, masks=masks), tmp_path, say=said.append)
    assert posed.cameras.sizes.tolist() == [[30, 40]] * count
    # clockwise: the left side is now on top
    carried = posed.mask(0)
    assert carried.shape == posed.image(0).shape[:2] == (40, 30)
    assert carried[:19].min() == 1
    assert carried[21:].max() == 0
    assert float(posed.cameras.world_from_camera[:, 2, 0].abs().max()) < 1e-4  # level
    assert float(posed.cameras.world_from_camera[:, 2, 1].max()) < 0  # and not upside down
    assert "12 of 12 photos lay on their side or upside down and were turned upright" in said


def test_a_dying_process_is_reported_in_one_line(tmp_path, monkeypatch):
    (tmp_path / "colmap_process").mkdir()
    program = tmp_path / "colmap_process" / "__main__.py"
    program.write_text("import sys; print('nothing to match', file=sys.stderr); sys.exit(3)")
    monkeypatch.setattr(structure_from_motion, "__file__", str(tmp_path / "structure_from_motion.py"))
    monkeypatch.setattr(structure_from_motion, "find_spec", lambda name: object())
    with pytest.raises(ValueError, match="exit code 3: nothing to match"):
        pose(photo_paths(tmp_path / "photos", 3), tmp_path)


# a phone: 26 mm equivalent is 0.72 longest sides
LENS = Lens(photos=("a", "b", "c"), size=(800, 600), focal_px=578.0, distortion=0.02)
ORDINARY = {
    "photos": 3,
    "observations": (900, 1100, 1000),
    "explained": 0.75,
    "mean_reprojection_px": 0.4,
    "lenses": (LENS,),
}


@pytest.mark.parametrize(
    ("change", "what", "found"),
    [
        ({"photos": 5}, "photos with a pose", "3 of 5"),
        ({"explained": 0.33}, "matches that the cameras explain", "33%"),
        ({"mean_reprojection_px": 1.05}, "mean reprojection error", "1.05 px"),
        ({"observations": (900, 40, 50)}, "points seen by the median photo", "50"),
        ({"lenses": (replace(LENS, focal_px=200.0, distortion=0.0),)}, "focal length of a and 2 more", "200 px"),
        ({"lenses": (replace(LENS, focal_px=5000.0),)}, "focal length of a and 2 more", "5000 px"),
        # the corner is 500 px from the middle: 0.5 (500 / 578)^2 = 37 percent
        ({"lenses": (replace(LENS, distortion=-0.5),)}, "distortion of a and 2 more", "37%"),
    ],
)
def test_each_figure_out_of_range_is_a_doubt(change: dict, what: str, found: str) -> None:
    assert find_doubts(**ORDINARY) == ()
    (doubt,) = find_doubts(**(ORDINARY | change))
    assert (doubt.what, doubt.found) == (what, found)
    assert str(doubt) == f"{what}: expected {doubt.expected}, found {found}"


def test_lenses_that_bend_each_photo_otherwise_are_doubted_and_doubts_come_back_from_their_file(tmp_path: Path) -> None:
    # corners moved by 15 percent inwards and outwards; the 10th and 90th percentile of three lie 0.8 of that apart
    k = 0.15 * 578**2 / 500**2
    lenses = tuple(replace(LENS, photos=(name,), distortion=d) for name, d in (("a", -k), ("b", 0.0), ("c", k)))
    doubts = find_doubts(**(ORDINARY | {"lenses": lenses}))
    assert [(doubt.what, doubt.found) for doubt in doubts] == [("spread of the distortion between photos", "24%")]
    assert read_doubts(tmp_path) == ()
    report = PoseReport(4, 3, (Unposed("d", 900, 12),), 0.4, 1000, 1, "global", 0.75, lenses, doubts)
    write_pose_report(tmp_path, report)
    assert read_doubts(tmp_path) == doubts
    assert all(isinstance(doubt, Doubt) for doubt in read_doubts(tmp_path))
    (tmp_path / "pose_report.json").write_text("{}")
    with pytest.raises(ValueError, match=r"pose_report\.json: expected figures of poses"):
        read_doubts(tmp_path)


def photo(path, size=(40, 30), model="Usual", focal=35.0):
    exif = Image.Exif()
    if model:
        exif[Base.Make], exif[Base.Model] = "Maker", model
        exif.get_ifd(IFD.Exif)[Base.FocalLength] = focal
    Image.new("RGB", size).save(path, exif=exif)
    return path


@pytest.mark.parametrize("other", [{"size": (36, 30)}, {"model": "Other"}, {"focal": 70.0}, {}, {"model": ""}])
def test_photos_of_equal_size_and_exif_share_a_camera(tmp_path: Path, other: dict) -> None:
    photos = [photo(tmp_path / name, **kind) for name, kind in (("0.jpg", {}), ("odd.jpg", other), ("1.jpg", {}))]
    copies = working_copies(photos, tmp_path / "copies", 1600)
    usual = ["0.jpg", "1.jpg"] if other else ["0.jpg", "odd.jpg", "1.jpg"]
    assert camera_groups(copies, shared=True) == [usual, *([["odd.jpg"]] if other else [])]
    assert camera_groups(copies, shared=False) == [["0.jpg"], ["odd.jpg"], ["1.jpg"]]


def floor_and_object():
    generator = torch.Generator().manual_seed(0)
    floor = torch.rand(600, 3, generator=generator) * 4 - 2
    floor[:, 2] = 0.002 * torch.randn(600, generator=generator)
    thing = 0.3 * torch.rand(300, 3, generator=generator) - torch.tensor([0.15, 0.15, 0.0])
    return torch.cat([floor, thing])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_in_any_frame_the_floor_comes_to_z_zero_with_cameras_above_at_a_median_distance_of_one(seed):
    generator = torch.Generator().manual_seed(seed)
    rotation = rotation_from_quaternion(torch.randn(1, 4, generator=generator))[0]
    lost = Similarity(scale=3.7, rotation=rotation, translation=torch.randn(3, generator=generator))
    cameras = lost.cameras(pinhole(circle(12), 200.0, width=160, height=120))
    points = lost.points(floor_and_object())
    found = upright(cameras, points)
    # 600 points with 2 mm of noise over 4 m fix a plane's tilt to far under a milliradian; distances here are about 2
    moved, centers = found.points(points), found.cameras(cameras).centers
    assert moved[:600, 2].abs().max() < 0.005
    assert (centers[:, 2] > 0.2).all()
    assert (moved[600:, 2] > -0.005).all()
    middle = found.points(points.median(0).values)  # a median per coordinate, in the frame of `upright`
    # float32 at distances of about ten
    assert torch.isclose((centers - middle).norm(dim=1).median(), torch.tensor(1.0), atol=1e-4)
    wall = torch.rand(500, 3, generator=generator)
    wall[:, 0] = 0
    assert dominant_level_plane(wall, UP) is None
    # without a plane the cameras define up; these are exactly level, so up is exact except for a prior
    turn = upright(cameras, lost.points(torch.randn(400, 3, generator=generator)))
    assert float((turn.rotation @ rotation @ UP)[2]) > math.cos(math.radians(1))


def corner_photo(camera):
    """Render three textured planes by a pinhole: rays meet the nearest plane, textures are looked up."""
    width, height = camera.width, camera.height
    v, u = np.mgrid[0:height, 0:width] + 0.5
    k, pose = camera.intrinsics[0].numpy(), camera.world_from_camera[0].numpy()
    rays = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], -1) @ pose[:3, :3].T
    generator = np.random.default_rng(0)
    color, nearest = np.zeros((height, width, 3), np.float32), np.full((height, width), np.inf)
    for axis in range(3):
        distance = (-1 - pose[axis, 3]) / rays[..., axis]
        hit = (distance > 0) & (distance < nearest)
        spot = pose[:3, 3] + distance[..., None] * rays
        a, b = ((np.delete(spot, axis, -1) + 1) * 200).astype(np.float32).transpose(2, 0, 1)
        looked_up = cv2.remap(texture(generator, 1024), a, b, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        color[hit], nearest[hit] = looked_up[hit], distance[hit]
    return torch.from_numpy(color).clamp(0, 1)


@needs_colmap
def test_true_poses_come_back_and_crops_have_their_optical_axis_where_it_was(tmp_path):
    angle = torch.linspace(0.35, 1.2, 10)
    eye = torch.stack([3 * angle.cos(), 3 * angle.sin(), 1 + 0.3 * (2 * angle).sin()], -1)
    truth = pinhole(look_at(eye, torch.tensor([-0.5, -0.5, -0.6]), UP), 400.0, width=400, height=300)
    (tmp_path / "photos").mkdir()
    paths, said = [tmp_path / "photos" / f"{name}.png" for name in truth.names], []
    for i, (camera, path) in enumerate(zip(truth, paths, strict=True)):
        picture = corner_photo(camera)
        # around 140, 105 instead of 200, 150
        write_image(path, picture[:210, :280] if i in {3, 6} else picture)
    photos = PhotoFiles(tuple(paths))
    posed, report = pose(photos, tmp_path, options=PoseOptions(effort="quick"), say=said.append)
    assert report.registered == 10
    # SIFT places features to about a third of a pixel
    assert report.mean_reprojection_px < 1
    rotation, distance = similarity_to(*(cameras.centers.double().numpy() for cameras in (truth, posed.cameras)))
    # a third of a pixel at a focal length of 400 and a distance of 4 is 3 mm; hundreds of points share it, but focal
    # length and distance trade against each other: one percent of the path's 2 m
    assert distance < 0.02
    # the floor fills most of the pictures and is level
    assert rotation[2, 2] > math.cos(math.radians(5))
    for i in (3, 6):
        # a turn of d / 400 makes up for an optical axis off by d pixels: a tenth of the 60 px that it is off, and
        # a tenth of the turn against the next whole photo
        assert posed.cameras.intrinsics[i, :2, 2].tolist() == pytest.approx([200, 150], abs=6)
        found, true = (c.world_from_camera[[i, i + 1], :3, :3].double() for c in (posed.cameras, truth))
        turn = found[0].T @ found[1] @ (true[0].T @ true[1]).T
        assert float(turn.trace()) > 1 + 2 * math.cos(6 / 400)
    assert any("the lens was solved separately" in sentence for sentence in said)


@pytest.mark.long
@needs_colmap
def test_bananas_on_a_carpet_are_one_model_with_the_known_poses(tmp_path: Path) -> None:
    """Pose sixteen photographs whose shipped poses come from a run with many more features, at twice the size.

    Incremental mapping of these smaller photos finds four models, the largest with 8 photos; the global mapper joins
    them.
    """
    posed, report = pose(find_photos(BANANAS / "images"), tmp_path, options=PoseOptions(effort="quick"))
    # two photos have hardly a feature on the carpet that both SIFT runs find
    assert report.registered >= 13
    known = read_capture(BANANAS)
    index = {Path(name).stem: i for i, name in enumerate(known.cameras.names)}
    truth = known.cameras.world_from_camera[[index[Path(name).stem] for name in posed.cameras.names]].double()
    found = posed.cameras.world_from_camera.double()
    focal = float(known.cameras.intrinsics[0, 0, 0])
    assert report.lenses[0].focal_px == pytest.approx(focal, rel=0.01)  # two runs of the same photos
    # the two worlds differ by a rotation: the mean rotation between them, by SVD; the rest is the error
    turns = truth[:, :3, :3] @ found[:, :3, :3].transpose(1, 2)
    u, _, vt = torch.linalg.svd(turns.sum(0))
    trace = ((u @ vt).T @ turns).diagonal(dim1=1, dim2=2).sum(1)
    # half a pixel at a focal length of 1110 px is 0.03 degrees; a wrong model is off by tens of degrees
    assert float(torch.rad2deg(torch.acos(((trace - 1) / 2).clamp(-1, 1))).max()) < 1
