"""Training pairs: Eq. 2, the relit object's statistics, the manifest, and the detection of defective renders."""

import json

import numpy as np
import pytest
import torch

from splatgraft.core.images import write_image
from splatgraft_paper.synthesis import pairs


def write_sample(folder, seed=0):
    """A folder as the worker leaves it: one camera, one object, one light, 48x40."""
    g = torch.Generator().manual_seed(seed)
    background = torch.rand(40, 48, 3, generator=g) * 0.5 + 0.2
    mask = torch.zeros(40, 48)
    mask[12:26, 15:30] = 1
    target = torch.where(mask[..., None] > 0, torch.rand(40, 48, 3, generator=g), background)
    for take, image in (("background", background), ("object0", target), ("object0_light0", target * 0.4 + 0.1)):
        (folder / take).mkdir(parents=True)
        write_image(folder / take / "0000.png", image)
    write_image(folder / "object0" / "0000_mask.png", mask)
    write_image(folder / "object0" / "0000_normal.png", torch.full((40, 48, 3), 0.9))
    write_image(folder / "object0" / "0000_albedo.png", target)
    np.save(folder / "object0" / "0000_depth.npy", np.ones((40, 48), np.float16))
    takes = [{"name": name} for name in ("background", "object0", "object0_light0")]
    (folder / "job.json").write_text(json.dumps({"takes": takes, "cameras": [{}], "provenance": {"kind": "test"}}))
    return pairs.PairSample(folder, 0, "object0", "light0")


def test_composite_is_the_papers_equation():
    relit, background, mask = torch.rand(5, 6, 3), torch.rand(5, 6, 3), torch.rand(5, 6)
    made = pairs.composite(relit, background, mask)
    for y in range(5):
        for x in range(6):
            expected = mask[y, x] * relit[y, x] + (1 - mask[y, x]) * background[y, x]
            assert torch.equal(made[y, x], expected)


def test_normalised_object_has_the_targets_mean_and_deviation():
    generator = torch.Generator().manual_seed(1)
    target = 0.4 + 0.05 * torch.randn(64, 64, 3, generator=generator)
    relit = 0.2 + 0.1 * torch.randn(64, 64, 3, generator=generator)
    mask = torch.zeros(64, 64)
    mask[10:50, 8:40] = 1
    made = pairs.match_statistics(relit, target, mask)[mask > 0]
    wanted = target[mask > 0]
    # nothing clips at eight deviations from 0 and 1, so only float32 sums over 1280 pixels err
    assert torch.allclose(made.mean(0), wanted.mean(0), atol=1e-5)
    assert torch.allclose(made.std(0), wanted.std(0), rtol=1e-4)


def test_sound_samples_make_the_manifest_and_come_back(tmp_path):
    sample = write_sample(tmp_path / "a")
    count, faults = pairs.write_manifest(tmp_path, [tmp_path / "a"])
    assert (count, faults) == (1, [])
    assert pairs.read_manifest(tmp_path) == [sample]


def damage_truncate(sample):
    path = sample.path("background")
    path.write_bytes(path.read_bytes()[:200])


def damage_remove(sample):
    sample.path(sample.object, "depth").unlink()


def damage_empty_mask(sample):
    write_image(sample.path(sample.object, "mask"), torch.zeros(40, 48))


def damage_black(sample):
    write_image(sample.path(sample.object), torch.zeros(40, 48, 3))


def damage_burnt(sample):
    write_image(sample.path(sample.object), torch.ones(40, 48, 3) - torch.eye(40, 48)[..., None])


def damage_dark_object(sample):
    write_image(sample.path("object0_light0"), torch.zeros(40, 48, 3))


@pytest.mark.parametrize(
    "damage",
    [damage_truncate, damage_remove, damage_empty_mask, damage_black, damage_burnt, damage_dark_object],
)
def test_bad_renders_are_caught_and_named(tmp_path, damage):
    sample = write_sample(tmp_path / "a")
    assert pairs.find_defect(sample) is None
    damage(sample)
    count, faults = pairs.write_manifest(tmp_path, [tmp_path / "a"])
    assert count == 0
    assert len(faults) == 1
    assert str(tmp_path / "a") in faults[0]
    assert "expected" in faults[0]


def test_broken_manifest_line_is_named(tmp_path):
    (tmp_path / "manifest.jsonl").write_text('{"folder": "a"}\n')
    with pytest.raises(ValueError, match=r"manifest.jsonl, line 1: expected folder, camera"):
        pairs.read_manifest(tmp_path)
