"""Metres per unit: from rays that meet, from a marker in warped pictures, and refusals."""

import cv2
import numpy as np
import pytest
import torch
from shapes import ring

from splatgraft.capture import scale_from_length, scale_from_marker, triangulate

CAMERAS = ring(6, radius=2.0, height=1.5, focal=700.0, size=(640, 480))


def project(index, points):
    pose = CAMERAS.camera_from_world[index]
    pixels = (points @ pose[:3, :3].T + pose[:3, 3]) @ CAMERAS.intrinsics[index].T
    return pixels[:, :2] / pixels[:, 2:]


def pictures_of_marker(side, name, number, *, shown=range(6), shift=0.0):
    """Draw a marker of `side` world units flat on the ground with a white border; `shift` moves it in every picture."""
    board = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)), number, 320)
    board = np.pad(board, 80, constant_values=255)
    half = side / 2 * 480 / 320
    corners = torch.tensor([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    images = []
    for index in range(6):
        picture = np.full((480, 640), 128, np.uint8)
        if index in shown:
            wanted = project(index, corners + torch.tensor([shift * index, 0, 0])).numpy().astype(np.float32) - 0.5
            edges = np.array([[-0.5, -0.5], [479.5, -0.5], [479.5, 479.5], [-0.5, 479.5]], np.float32)
            warp = cv2.getPerspectiveTransform(edges, wanted)
            picture = cv2.warpPerspective(
                board, warp, (640, 480), dst=picture, borderMode=cv2.BORDER_TRANSPARENT, flags=cv2.INTER_AREA
            )
        images.append(torch.from_numpy(picture).float()[..., None].expand(-1, -1, 3) / 255)
    return images


def test_rays_through_the_same_point_meet_there():
    point = torch.tensor([[0.1, -0.2, 0.3]])
    pixels = torch.cat([project(index, point) for index in (0, 2, 3)])
    found, miss_px = triangulate(CAMERAS[[0, 2, 3]], pixels)
    assert torch.allclose(found, point[0], atol=1e-4)
    assert miss_px < 0.01
    _, miss_px = triangulate(CAMERAS[[0, 2, 3]], pixels + torch.tensor([[5.0, 0], [0, 5.0], [-5.0, 0]]))
    assert miss_px > 1
    with pytest.raises(ValueError, match="expected images from different directions, found almost the same"):
        triangulate(CAMERAS[[0, 0]], pixels[[0, 0]])


@pytest.mark.parametrize(("name", "number"), [("DICT_APRILTAG_36h11", 7), ("DICT_4X4_50", 3)])
def test_a_marker_of_known_size_gives_the_scale(name, number):
    found = scale_from_marker(pictures_of_marker(0.4, name, number), CAMERAS, 0.05)
    # 0.4 units are 0.05 m; corners are found within a fifth of a pixel, on sides of about 100 px
    assert found.metres_per_unit == pytest.approx(0.125, rel=0.005)
    assert f"{name.removeprefix('DICT_')} marker {number} of 0.05 m in 6 images" in found.source


def test_a_marker_in_one_picture_or_one_that_moves_is_refused():
    with pytest.raises(ValueError, match="expected an AprilTag or ArUco marker in two images, found 1 in one"):
        scale_from_marker(pictures_of_marker(0.4, "DICT_4X4_50", 3, shown=[2]), CAMERAS, 0.05)
    with pytest.raises(ValueError, match="expected corners that meet within 3 px"):
        scale_from_marker(pictures_of_marker(0.4, "DICT_4X4_50", 3, shift=0.05), CAMERAS, 0.05)


def test_a_length_gives_the_scale():
    ends = (torch.tensor([0.0, 0, 0]), torch.tensor([0.0, 3.0, 4.0]))
    assert scale_from_length(ends, 0.5).metres_per_unit == pytest.approx(0.1)
    with pytest.raises(ValueError, match="expected two points apart"):
        scale_from_length((ends[0], ends[0]), 0.5)
