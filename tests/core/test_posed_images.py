"""Posed images: pixels at the cameras' size, undistorted; selecting views selects all that belongs to them."""

import numpy as np
import torch
from PIL import Image

from splatgraft.core.cameras import pinhole
from splatgraft.core.distortion import Distortion
from splatgraft.core.posed_images import PosedImages, held_out


def capture(tmp_path, *, distortions=()):
    rng = np.random.default_rng(0)
    paths, masks = [], []
    for i in range(3):
        paths.append(tmp_path / f"{i}.png")
        masks.append(tmp_path / f"mask_{i}.png")
        Image.fromarray(rng.integers(0, 256, (16, 24, 3), dtype=np.uint8)).save(paths[-1])
        Image.fromarray(rng.integers(0, 256, (16, 24), dtype=np.uint8)).save(masks[-1])
    return PosedImages(
        image_paths=tuple(paths),
        cameras=pinhole(torch.eye(4).repeat(3, 1, 1), 20.0, width=24, height=16),
        points=torch.zeros(0, 3),
        point_colors=torch.zeros(0, 3),
        mask_paths=(masks[0], None, masks[2]),
        distortions=distortions,
    )


def test_views_keep_their_own(tmp_path):
    lens = Distortion(
        intrinsics=torch.tensor([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]], dtype=torch.float64),
        coefficients=torch.tensor([0.05, 0, 0, 0, 0], dtype=torch.float64),
        size=(24, 16),
    )
    whole = capture(tmp_path, distortions=(None, None, lens))
    part = whole.select(torch.tensor([False, True, True]))
    assert len(part) == 2
    assert part.distortions == (None, lens)
    assert part.mask(0) is None
    for i in range(2):
        assert torch.equal(part.image(i), whole.image(i + 1))
    assert torch.equal(part.mask(1), whole.mask(2))


def test_resized_halves_by_the_mean(tmp_path):
    whole = capture(tmp_path)
    half = whole.resized(0.5)
    expected = whole.image(0).reshape(8, 2, 12, 2, 3).mean((1, 3))
    assert (half.image(0) - expected).abs().max() < 1e-6  # float32 sums of four
    assert half.mask(0).shape == (8, 12)


def test_no_distortion_is_exact(tmp_path):
    none = Distortion(
        intrinsics=torch.tensor([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]], dtype=torch.float64),
        coefficients=torch.zeros(5, dtype=torch.float64),
        size=(24, 16),
    )
    assert np.abs(none.pinhole() - none.intrinsics.numpy()).max() < 1e-9
    plain, same = capture(tmp_path), capture(tmp_path, distortions=(none,) * 3)
    assert (plain.image(0) - same.image(0)).abs().max() < 1e-4  # float32 maps: 1e-6 px off, contrast 1


def test_poses_refer_to_the_stored_grid(tmp_path):
    whole = capture(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(whole.image_paths[0]) as image:
        before = whole.image(0)
        image.copy().save(whole.image_paths[0], exif=exif)
    assert torch.equal(whole.image(0), before)


def test_every_eighth_is_held_out():
    assert torch.nonzero(held_out(20)).flatten().tolist() == [0, 8, 16]
