"""`capture` on broken and unusual captures: it continues with a message, or refuses in one line and changes nothing."""

import json
import shutil
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from made_captures import SIZE, colmap_answer, disc, texture, write_photos, write_posed
from PIL import Image

from splatgraft.capture import read_doubts, structure_from_motion
from splatgraft.cli import main
from splatgraft.core import images
from splatgraft.core.exposure import Exposure
from splatgraft.core.posed_images import LeftOut
from splatgraft.folders.capture_files import left_out_notes
from splatgraft.formats import read_capture
from splatgraft.formats.captures.exif import exif_of, read_exposure
from splatgraft.formats.captures.photo_archive import unpack_photos
from splatgraft.steps.reconstruct import far_worse

LARGE = (SIZE[0] * 8, SIZE[1] * 8)


@pytest.fixture
def capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Run the command on c/, check its exit status, and return its output."""

    def run(*more: str, status: int = 0) -> str:
        capsys.readouterr()
        assert main(["capture", str(tmp_path / "c"), "--out", str(tmp_path / "out"), *more]) == status
        return capsys.readouterr().err

    return run


def change(folder: Path, *frames: int, **keys: object) -> None:
    """Change keys of a transforms.json, or of some of its frames."""
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    for entry in [meta["frames"][index] for index in frames] if frames else [meta]:
        entry.update(keys)
    path.write_text(json.dumps(meta))


@pytest.mark.parametrize(("kept", "level"), [(50, "minor"), (20, "warning")])
def test_a_capture_with_plenty_of_photos_is_not_in_doubt_for_those_left_out(kept: int, level: str) -> None:
    left_out = [LeftOut(f"{i}.jpg", f"{i}.jpg: expected an image file, found none") for i in range(17)]
    head, _ = left_out_notes(Path("fox"), kept, left_out)
    assert (head.level, f"uses {kept} of {kept + 17} images" in head.text) == (level, True)


def test_what_is_not_usable_is_named_counted_and_left_out(tmp_path: Path, capture) -> None:
    photos = write_posed(tmp_path / "c", 14)
    photos[1].unlink()
    photos[2].write_bytes(photos[2].read_bytes()[:5000])
    Image.new("RGB", (1, 1)).save(photos[3])
    change(tmp_path / "c", 4, transform_matrix=[[float("nan")] * 4] * 4)
    Image.fromarray(texture(0)).save(photos[5])
    said = capture()
    assert read_capture(tmp_path / "out").cameras.names == tuple(p.name for p in (photos[0], *photos[6:]))
    head = next(line for line in said.splitlines() if "warning" in line)
    assert "uses 9 of 14 images" in head
    assert all(f"{i:04d}.png" in head for i in range(1, 6))
    # the photos around the first one are left out
    assert "none between 0000.png and 0006.png" in said
    for reason in ("found none in", "truncated", "found 1x1", "finite numbers", "a copy of it"):
        assert reason in said


def test_fewer_than_half_are_refused_and_the_earlier_result_stays(tmp_path: Path, capture) -> None:
    photos = write_posed(tmp_path / "c", 12)
    capture()
    earlier = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    for photo in photos[:7]:
        photo.unlink()
    said = capture(status=2)
    assert "transforms.json: expected at least 50% of 12 images to be usable, found 5" in said.splitlines()[-1]
    # found only while the step works
    for photo in photos:
        Image.fromarray(texture(0)).save(photo)
    said = capture(status=2)
    assert "expected at least 8 posed views with a parallax of 3 degrees" in said
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()} == earlier
    assert not (tmp_path / ".out.new").exists()


def test_images_without_a_pose_are_counted_and_intrinsics_of_zero_refused_in_one_line(tmp_path: Path, capture) -> None:
    write_posed(tmp_path / "c", 30)
    frames = json.loads((tmp_path / "c" / "transforms.json").read_text())["frames"]
    change(tmp_path / "c", frames=frames[::3])
    said = capture()
    assert "only 10 of the 30 images in" in said
    change(tmp_path / "c", frames=frames[:3])
    said = capture(status=2)
    assert "are usual), found 3" in said.splitlines()[-1]
    change(tmp_path / "c", fl_x=0, fl_y=0)
    said = capture(status=2)
    (line,) = said.splitlines()
    assert "c/transforms.json" in line
    assert "focal length above 0" in line


def test_masks_of_one_colour_or_another_size_are_left_out(tmp_path: Path, capture) -> None:
    photos = write_posed(tmp_path / "c", 10, masks=True)
    masks = [tmp_path / "c" / "masks" / photo.name for photo in photos]
    Image.fromarray(np.zeros_like(disc())).save(masks[1])
    Image.fromarray(np.full_like(disc(), 255)).save(masks[2])
    Image.fromarray(disc()).resize((50, 50)).save(masks[3])
    Image.fromarray(disc()).resize((SIZE[0] // 2, SIZE[1] // 2)).save(masks[4])  # the mask keeps its shape
    said = capture()
    found = read_capture(tmp_path / "out")
    assert [path is None for path in found.mask_paths] == [False, True, True, True, *[False] * 6]
    assert "uses 10 of 10 images, without the mask of images/0003.png, the mask of 0001.png" in said
    assert "0001.png: expected white where the object is, found black all over" in said
    assert "0002.png: expected white where the object is, found white all over" in said
    assert "0003.png: expected 160x120 px" in said
    for mask in masks:
        Image.fromarray(np.zeros_like(disc())).save(mask)
    said = capture()
    assert read_capture(tmp_path / "out").mask_paths == ()
    assert "and 2 more" in said


def test_large_photos_are_reduced_once_with_masks_and_exposure(tmp_path: Path, capture) -> None:
    photos = write_posed(tmp_path / "c", 10, masks=True)
    large = photos[3].with_suffix(".jpg")
    photos[3].unlink()
    exif = exif_of(Exposure(1 / 60, 8.0, 100.0))
    Image.fromarray(texture(3)).resize(LARGE, Image.Resampling.BICUBIC).save(large, quality=97, exif=exif)
    change(tmp_path / "c", 3, file_path="images/0003.jpg")
    capture("--max-side", "200")
    found, given = read_capture(tmp_path / "out"), read_capture(tmp_path / "c")
    # the other images stay in their folder
    inside = [path.resolve().is_relative_to(tmp_path / "out") for path in found.image_paths]
    assert inside == [i == 3 for i in range(10)]
    assert images.stored_size(found.image_paths[3]) == SIZE
    assert read_exposure(found.image_paths[3]).shutter_s == pytest.approx(1 / 60)
    assert torch.equal(found.cameras.intrinsics, given.cameras.intrinsics)
    # JPEG of quality 95 rounds this noise by 3 grey levels in the mean, which add to those of the photo
    assert float((found.image(3) - given.image(3)).abs().mean()) < 6 / 255
    truth, mask = given.mask(3), found.mask(3)
    assert truth is not None
    assert mask is not None
    assert torch.equal(mask > 0.5, truth > 0.5)


def test_distorted_large_photos_are_reduced_without_distortion(tmp_path: Path, capture) -> None:
    write_posed(tmp_path / "c", 10)
    change(tmp_path / "c", k1=-0.1)
    capture("--max-side", "80")
    found, given = read_capture(tmp_path / "out"), read_capture(tmp_path / "c").limited(80)
    assert found.distortions == ()
    torch.testing.assert_close(found.cameras.intrinsics, given.cameras.intrinsics)
    # reduced before and after the distortion is removed; JPEG
    for i in range(10):
        assert float((found.image(i) - given.image(i)).abs().mean()) < 6 / 255


def test_small_photos_are_not_shrunk_with_large_ones(tmp_path: Path, capture) -> None:
    photos = write_posed(tmp_path / "c", 10)
    Image.fromarray(texture(3)).resize(LARGE, Image.Resampling.BICUBIC).save(photos[3])
    size = {"w": 160, "h": 120, "fl_x": 150, "fl_y": 150, "cx": 80, "cy": 60}
    change(tmp_path / "c", *range(10), **size)
    change(tmp_path / "c", 3, **{key: value * 8 for key, value in size.items()})
    capture("--max-side", "320")
    assert read_capture(tmp_path / "out").cameras.sizes.tolist() == [[160, 120]] * 3 + [[320, 240]] + [[160, 120]] * 6


def test_photos_without_poses_that_are_one_photo_or_cannot_be_read_are_refused(
    tmp_path: Path, capture, monkeypatch
) -> None:
    photos = write_photos(tmp_path / "c", 12)
    for photo in photos:
        Image.fromarray(texture(0)).save(photo)
    line = capture(status=2).splitlines()[-1]
    assert line.startswith(f"splatgraft: {tmp_path / 'c'}: expected at least 8 different photos")
    assert "found 1 of 12" in line
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(images, "find_spec", lambda name: None)
    for i, photo in enumerate(photos):
        photo.unlink()
        photo.with_name(f"IMG_{i}.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    line = capture(status=2).splitlines()[-1]
    assert "IMG_0.HEIC" in line
    assert "pip install 'splatgraft[heic]'" in line


@pytest.mark.skipif(find_spec("pillow_heif") is None, reason="pillow-heif is an optional extra")
def test_heic_is_read(tmp_path: Path) -> None:
    import pillow_heif

    pillow_heif.register_heif_opener()
    pixels = texture(1)[..., :1].repeat(3, -1)  # HEIC halves the resolution of colour only
    Image.fromarray(pixels).save(tmp_path / "a.heic", quality=95)
    assert images.list_images(tmp_path) == [tmp_path / "a.heic"]
    # lossy, but close to the original
    assert float((images.read_rgb(tmp_path / "a.heic") - torch.from_numpy(pixels).float() / 255).abs().mean()) < 0.03
    assert images.stored_size(tmp_path / "a.heic") == SIZE


def test_given_poses_and_masks_come_together_and_what_has_no_partner_is_named(tmp_path: Path, capture) -> None:
    photos = write_photos(tmp_path / "c" / "images", 14, ".jpg")
    masks = {0: disc(), 1: 0 * disc(), 2: 0 * disc() + 255, 3: disc()[:, 20:140]}
    for index, mask in masks.items():
        Image.fromarray(mask).save(photos[index].with_name(f"{photos[index].stem}_mask.png"))
    posed = [i for i in range(14) if i != 5]
    frames = []
    for i, name in enumerate([*(f"{i:04d}.png" for i in posed), "99.png"]):
        pose = np.eye(4)
        pose[0, 3] = i
        frames.append({"file_path": f"somewhere/{name}", "transform_matrix": pose.tolist()})
    poses = tmp_path / "theirs" / "transforms.json"
    poses.parent.mkdir()
    poses.write_text(json.dumps({"w": SIZE[0], "h": SIZE[1], "fl_x": 130.0, "frames": frames}))
    for given in (poses, poses.parent):
        said = capture("--poses", str(given))
        found = read_capture(tmp_path / "out")
        assert [path.name for path in found.image_paths] == [f"{i:04d}.jpg" for i in posed]
        assert found.cameras.world_from_camera[:, 0, 3].tolist() == list(range(13))
        assert [path and path.name for path in found.mask_paths] == ["0000_mask.png", *[None] * 12]
        for expected in (
            "poses of 13 of 14 photos",
            "without a pose, left out: 0005.jpg",
            "99.png",
            "1 of 14 photos have masks",
            "the mask of 0001.jpg, the mask of 0002.jpg, the mask of 0003.jpg",
            "0001_mask.png: expected white where the object is, found black all over",
            "0003_mask.png: expected 160x120 px",
        ):
            assert expected in said
    shutil.rmtree(tmp_path / "c")
    (tmp_path / "c").touch()
    said = capture("--poses", str(poses), status=2)
    assert "expected a folder or a .zip of photos beside --poses" in said


def test_a_zip_is_the_photos_and_masks_in_it(tmp_path: Path) -> None:
    write_posed(tmp_path / "c", 10, masks=True)
    (tmp_path / "given").mkdir()
    for name in ("points.ply", "transforms.json"):
        poses = (tmp_path / "c" / name).rename(tmp_path / "given" / name)
    shutil.make_archive(str(tmp_path / "c"), "zip", tmp_path / "c")
    found = []
    for name in ("c", "c.zip"):
        out = tmp_path / f"out_{name}"
        assert main(["capture", str(tmp_path / name), "--poses", str(poses), "--out", str(out)]) == 0
        found.append(read_capture(out))
    folder, archive = found
    assert archive.cameras.names == folder.cameras.names
    assert torch.equal(archive.cameras.world_from_camera, folder.cameras.world_from_camera)
    assert [path.read_bytes() for path in archive.image_paths] == [path.read_bytes() for path in folder.image_paths]
    for index in range(10):
        mask = folder.mask(index)
        assert mask is not None
        assert torch.equal(archive.mask(index), mask)


def test_a_zip_whose_photos_are_damaged_inside_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "c.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("0.png", bytes(range(256)) * 400)
    content = bytearray(path.read_bytes())
    content[40:200] = b"\xff" * 160
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"c\.zip: expected a \.zip of photos, found one that cannot be read"):
        unpack_photos(path, tmp_path / "photos")
    # zipfile would unpack all of a bzip2 at once, at any size
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("0.png", bytes(1000))
    with pytest.raises(ValueError, match=r"c\.zip: expected a \.zip of photos, found one that is not deflated"):
        unpack_photos(path, tmp_path / "photos")
    # a drive of Windows
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("C:/0.png", bytes(1000))
    with pytest.raises(ValueError, match=r"found one that writes outside of its folder, to C:/0\.png"):
        unpack_photos(path, tmp_path / "photos")
    assert [entry.name for entry in tmp_path.iterdir()] == ["c.zip"]


@pytest.fixture
def doubtful(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a project, and a COLMAP that answers with all photos and an error of 1.05 px. Every call is recorded."""
    calls: list[str] = []

    def answer(job, advance, say):
        calls.append(job.photos)
        poses = torch.eye(4).repeat(8, 1, 1)
        poses[:, :3, 3] = torch.arange(8.0)[:, None]
        points = [[0.0, 0.0, 5.0, 255, 0, 0, 0.3, 4]]
        return colmap_answer(job.names, poses, SIZE, mean_reprojection_px=1.05, points=points)

    monkeypatch.setattr(structure_from_motion, "find_spec", lambda name: object())
    monkeypatch.setattr(structure_from_motion, "_run", answer)
    for side in ("source", "target"):
        write_photos(tmp_path / side / "photos", 8)
    write_project(tmp_path)
    return calls


def write_project(folder: Path, key: str = "") -> None:
    side = '[{0}]\ncapture = "{0}/photos"\neffort = "quick"\n' + key + "\n"
    (folder / "project.toml").write_text(side.format("source") + side.format("target"))


def test_run_stops_at_doubtful_poses_with_one_line_that_says_what_and_how_to_go_on(
    tmp_path: Path, doubtful: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(tmp_path), "--to", "source/reconstruct"]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    for expected in ("mean reprojection error", "at most 1.00 px", "1.05 px", "more photos", "accept_doubtful = true"):
        assert expected in last
    assert not (tmp_path / "source" / "scene").exists()
    assert [doubt.found for doubt in read_doubts(tmp_path / "source" / "capture")] == ["1.05 px"]
    assert (tmp_path / "source" / "capture" / "transforms.json").is_file()


def test_it_stops_again_without_work_and_goes_on_with_the_same_poses_when_told_to(
    tmp_path: Path, doubtful: list[str]
) -> None:
    words = ["run", str(tmp_path), "--to", "capture"]
    assert main(words) == 2
    assert main(words) == 2
    assert len(doubtful) == 1
    assert main([*words, "--accept-doubtful"]) == 0
    assert len(doubtful) == 2  # the source's are kept; the target's are made
    write_project(tmp_path, key="accept_doubtful = true")
    assert main(words) == 0
    assert len(doubtful) == 2


def test_held_out_views_far_below_the_rest_are_named() -> None:
    usual = {f"photo_{i}": 25 + 0.3 * (i % 4) for i in range(9)}
    assert far_worse(usual) == {}
    worse = far_worse(usual | {"odd": 14.0, "turned": 11.0})
    assert list(worse) == ["turned", "odd"]
    assert all(name in sentence for name, sentence in worse.items())
    # if views differ much, the deviation is 1.4826 x 3 dB, and three deviations lie below every view
    assert far_worse({f"photo_{i}": 18.0 + i for i in range(13)}) == {}
