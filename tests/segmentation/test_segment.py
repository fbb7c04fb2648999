"""`segment`: the object of a masked capture and its surroundings, as lifting and selecting alone give them."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.spherical_harmonics import dc_from_rgb
from splatgraft.rendering import render
from splatgraft.segmentation import SelectOptions, SolidifyOptions, lift_masks, segment, select_object


def blob(center: tuple[float, float, float], rgb: tuple[float, float, float], seed: int) -> Gaussians:
    means = torch.tensor(center) + 0.15 * torch.randn(40, 3, generator=torch.Generator().manual_seed(seed))
    return Gaussians(
        means=means,
        log_scales=torch.full((40, 3), -2.3),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(40, 1),
        opacity_logits=torch.full((40,), 2.0),
        sh=dc_from_rgb(torch.tensor(rgb)).repeat(40, 1)[:, None],
    )


@pytest.fixture(scope="module")
def masked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Gaussians, PosedImages]:
    """Two blobs side by side, the second is the object; the last of five views has no mask."""
    folder: Path = tmp_path_factory.mktemp("capture")
    scene = concatenate([blob((-0.8, 0, 0), (0.2, 0.5, 0.7), 0), blob((0.8, 0, 0), (0.9, 0.3, 0.1), 1)])
    angles = torch.linspace(-1.2, 1.2, 5)
    eyes = torch.stack([3 * angles.sin(), -3 * angles.cos(), torch.full((5,), 0.5)], 1)
    cameras = pinhole(look_at(eyes, torch.zeros(3), torch.tensor([0.0, 0, 1])), 50.0, width=64, height=48)
    drawn = render(scene, cameras, features=(torch.arange(80) >= 40)[:, None].float())
    images, masks = ([folder / f"{kind}{i}.png" for i in range(5)] for kind in ("image", "mask"))
    for index in range(5):
        write_image(images[index], drawn.color[index])
        write_image(masks[index], (drawn.features[index, ..., 0] > 0.5).float())
    none = torch.zeros(0, 3)
    return scene, PosedImages(tuple(images), cameras, none, none, mask_paths=(*masks[:4], None))


def test_the_parts_are_those_of_lifting_and_selecting(masked: tuple[Gaussians, PosedImages]) -> None:
    scene, capture = masked
    options = SelectOptions(threshold=0.5)
    found = segment(scene, capture, select=options, solidify=None)
    masks = [mask for index in range(5) if (mask := capture.mask(index)) is not None]
    feature = lift_masks(scene, capture.cameras[:4], masks)
    assert torch.equal(found.feature, feature)
    assert torch.equal(found.selection, select_object(scene, feature, options))
    assert torch.equal(found.object.means, scene.means[found.selection])
    assert torch.equal(found.surroundings.sh, scene.sh[~found.selection])
    # the blobs do not overlap in any view, so nearly all Gaussians are told apart; those at a silhouette may miss
    assert int((found.selection == (torch.arange(80) >= 40)).sum()) >= 72


def test_solidifying_changes_the_object_alone(masked: tuple[Gaussians, PosedImages]) -> None:
    scene, capture = masked
    plain, solid = (
        segment(scene, capture, select=SelectOptions(threshold=0.5), solidify=how)
        for how in (None, SolidifyOptions(iterations=3))
    )
    assert torch.equal(plain.selection, solid.selection)
    assert torch.equal(plain.surroundings.opacity_logits, solid.surroundings.opacity_logits)
    assert not torch.equal(plain.object.opacity_logits, solid.object.opacity_logits)


def test_a_capture_without_masks_is_refused(masked: tuple[Gaussians, PosedImages]) -> None:
    scene, capture = masked
    with pytest.raises(ValueError, match="expected masks of the object for some of 5 views, found none"):
        segment(scene, replace(capture, mask_paths=()))
