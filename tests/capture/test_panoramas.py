"""360-degree panoramas: recognition, the views cut out of them, and their poses in a room of known size."""

import math
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from made_up_photos import panoramas, similarity_to, texture
from PIL import Image
from PIL.ExifTags import IFD, Base

from splatgraft.capture import read_doubts
from splatgraft.capture.panoramas import are_panoramas, cut_views, panorama_from_views
from splatgraft.cli import main
from splatgraft.core.directions import even_directions
from splatgraft.core.images import read_rgb
from splatgraft.formats import read_capture

needs_colmap = pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is an optional extra")


def picture(path: Path, width: int, height: int, *, seed: int = 0, custom_rendered: int | None = None) -> Path:
    """Write an ordinary textured picture."""
    pixels = cv2.resize(texture(np.random.default_rng(seed), 512), (width, height))
    exif = Image.Exif()
    if custom_rendered is not None:
        exif.get_ifd(IFD.Exif)[Base.CustomRendered] = custom_rendered
    Image.fromarray((pixels * 255).round().astype(np.uint8)).save(path, exif=exif)
    return path


def test_spheres_are_recognised_and_flat_panoramas_refused(tmp_path: Path) -> None:
    panoramas(tmp_path / "round", 3, 512)
    spheres = sorted((tmp_path / "round").iterdir())
    assert are_panoramas(spheres)
    # a phone's photos of 18:9 and of 4:3
    photos = [picture(tmp_path / f"{i}.jpg", 600, height, seed=i) for i, height in enumerate((300, 450, 300))]
    assert not are_panoramas(photos)
    flat = picture(tmp_path / "flat.jpg", 1600, 400)
    with pytest.raises(ValueError, match=r"flat\.jpg: expected a photo, or a 360.*flat panorama of 1600 x 400"):
        are_panoramas([*photos, flat])
    marked = picture(tmp_path / "marked.jpg", 800, 400, custom_rendered=6)
    with pytest.raises(ValueError, match=r"marked\.jpg: expected .* flat panorama of 800 x 400"):
        are_panoramas([marked])
    with pytest.raises(ValueError, match=r"0\.jpg: expected a 360-degree panorama like 00\.jpg, found another photo"):
        are_panoramas([*spheres, photos[0]])
    panoramas(tmp_path / "larger", 1, 640)
    with pytest.raises(ValueError, match=r"expected panoramas of one size, found 512 x 256, 640 x 320"):
        are_panoramas([*spheres, *(tmp_path / "larger").iterdir()])


def test_the_views_show_all_but_what_is_below(tmp_path: Path) -> None:
    """Each pixel's colour is its direction, so every view must show its own directions."""
    width = 512
    v, u = np.mgrid[0 : width // 2, 0:width] + 0.5
    yaw, pitch = 2 * np.pi * (u / width - 0.5), np.pi * (0.5 - 2 * v / width)
    rays = np.stack([np.cos(pitch) * np.sin(yaw), -np.sin(pitch), np.cos(pitch) * np.cos(yaw)], -1)
    Image.fromarray((255 * (0.5 + 0.5 * rays)).round().astype(np.uint8)).save(tmp_path / "sphere.png")
    files, poses = cut_views(tmp_path / "sphere.png", tmp_path), panorama_from_views()
    assert len(files) == len(poses) == 8
    place = (torch.arange(128) + 0.5) / 64 - 1
    down, across = torch.meshgrid(place, place, indexing="ij")
    pinhole = torch.nn.functional.normalize(torch.stack([across, down, torch.ones_like(down)], -1), dim=-1)
    for file, pose in zip(files, poses, strict=True):
        # half a step of 8 bits twice, interpolation over pixels of 0.7 degrees, and JPEG's colours at half resolution
        assert float((2 * read_rgb(file) - 1 - pinhole @ pose[:3, :3].T).abs().max()) < 0.06
    inside = torch.einsum("vij,ni->vnj", poses[:, :3, :3], even_directions(2000))
    seen = ((inside[..., :2].abs() <= inside[..., 2:] + 1e-6) & (inside[..., 2:] > 0)).all(-1).any(0)
    height = torch.asin(-even_directions(2000)[:, 1])
    # the corners of the lower views reach 35 degrees below the horizon, the middle of their lower edges 45
    assert bool(seen[height > math.radians(-35)].all())
    assert not bool(seen[height < math.radians(-45.1)].any())


@needs_colmap
@pytest.mark.long
def test_panoramas_of_a_room_get_their_poses(tmp_path: Path) -> None:
    truth = panoramas(tmp_path / "photos", 8, 1024)
    out = tmp_path / "capture"
    assert main(["capture", str(tmp_path / "photos"), "--out", str(out), "--threads", "1"]) == 0
    assert not read_doubts(out)
    posed = read_capture(out)
    assert (len(posed), posed.cameras.width) == (64, 256)
    centers = posed.cameras.centers.reshape(8, 8, 3)
    assert float((centers - centers[:, :1]).norm(dim=-1).max()) < 1e-5
    rotation, error = similarity_to(truth[:, :3, 3], centers[:, 0].double().numpy())
    # the path is 3 wide; a third of a pixel at SIFT's accuracy is 0.12 degrees, over 3 units 0.006, less by averaging
    assert error < 0.01 * 3
    wanted = truth[:, None, :3, :3] @ panorama_from_views()[:, :3, :3].double().numpy()
    found = rotation @ posed.cameras.world_from_camera[:, :3, :3].reshape(8, 8, 3, 3).double().numpy()
    cosine = (np.einsum("pvij,pvij->pv", wanted, found) - 1) / 2
    assert np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).max() < 0.5
    # upright: the views towards the horizon look level, and the walls' points lie within the room
    assert float(posed.cameras.world_from_camera[:, 2, 2].reshape(8, 8)[:, :4].abs().max()) < 0.02


@needs_colmap
@pytest.mark.long
def test_a_360_video_is_posed_as_panoramas(tmp_path: Path) -> None:
    truth = panoramas(tmp_path / "frames", 24, 1024, is_video=True)
    video = cv2.VideoWriter(str(tmp_path / "walk.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, (1024, 512))
    for file in sorted((tmp_path / "frames").iterdir()):
        video.write(cv2.imread(str(file)))
    video.release()
    out = tmp_path / "capture"
    assert main(["capture", str(tmp_path / "walk.mp4"), "--out", str(out), "--threads", "1"]) == 0
    posed = read_capture(out)
    centers = posed.cameras.centers.reshape(-1, 8, 3)
    assert len(centers) >= 8
    assert float((centers - centers[:, :1]).norm(dim=-1).max()) < 1e-5
    numbers = [int(name.split("_")[1]) for name in posed.cameras.names[::8]]
    _, error = similarity_to(truth[numbers, :3, 3], centers[:, 0].double().numpy())
    # as for panoramas that are photos, and twice that for the video's compression
    assert error < 0.02 * 3
