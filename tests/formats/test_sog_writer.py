"""Scenes as .sog: what is read back is within the format's steps, also by the format's own tool."""

import json
import zipfile

import format_files
import numpy as np
import pytest
import torch
from test_scenes_of_other_tools import SOG, assert_within

from splatgraft import formats
from splatgraft.core.gaussians import empty
from splatgraft.formats.scenes.code_book import nearest_codes, palette, scalar_codes
from splatgraft.formats.scenes.scene_metadata import SceneMetadata
from splatgraft.formats.scenes.sog_writer import write_sog


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_few_gaussians_are_within_the_steps_of_the_format(tmp_path, degree):
    g = format_files.random_gaussians(40, degree, seed=11)
    formats.write_gaussians(tmp_path / "a.sog", g)
    # fewer numbers than codes: exact, but for bands, whose 256 codes hold up to 40 * 45 values
    steps = SOG | {"log_scales": 1e-5, "dc": 1e-5, "opacities": 0.51 / 255, "bands": 0.02}
    assert_within(g, formats.read_gaussians(tmp_path / "a.sog"), steps)


def test_the_same_scene_gives_the_same_bytes(tmp_path):
    g = format_files.random_gaussians(2000, 3)
    for name in ("a.sog", "b.sog"):
        formats.write_gaussians(tmp_path / name, g)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_the_picture_of_meta_json(tmp_path):
    metadata = SceneMetadata(up=(0.0, 0.0, 1.0), metres_per_unit=0.25)
    write_sog(tmp_path / "a.sog", format_files.random_gaussians(10, 2), metadata)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
        meta = json.loads(archive.read("meta.json"))
        assert {name for part in meta.values() if isinstance(part, dict) for name in part.get("files", [])} == {
            entry for entry in archive.namelist() if entry != "meta.json"
        }
    assert (meta["version"], meta["count"], meta["shN"]["bands"]) == (2, 10, 2)
    assert meta["splatgraft"] == {"up": [0, 0, 1], "metres_per_unit": 0.25}


def test_no_gaussians_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"a\.sog: expected at least one Gaussian for a \.sog file, found none"):
        formats.write_gaussians(tmp_path / "a.sog", empty())
    assert list(tmp_path.iterdir()) == []


def test_scalar_codes_are_nearly_the_best():
    """Against uniform steps: Lloyd's codes are fitted to where the values are."""
    values = np.random.default_rng(0).normal(size=20_000) ** 3
    codes = scalar_codes(values)
    error = np.square(codes[nearest_codes(values, codes)] - values).mean()
    steps = np.linspace(values.min(), values.max(), 256)
    uniform = np.square(steps[nearest_codes(values, steps.astype(np.float32))] - values).mean()
    assert error < 0.25 * uniform
    # the nearest code is the nearest one
    some = values[:500]
    off = np.abs(some[:, None] - codes)
    assert (np.abs(codes[nearest_codes(some, codes)] - some) <= off.min(1) + 1e-5).all()  # codes in float32


def test_a_palette_keeps_to_its_size_and_beats_one_of_random_rows():
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(50, 9, generator=generator)[torch.randint(50, (9000,), generator=generator)]
    rows = rows + 0.1 * torch.randn(9000, 9, generator=generator)
    entries, labels = palette(rows, 1024)
    assert len(entries) <= 1024
    assert labels.max() < len(entries)
    error = (entries[labels] - rows).square().mean()
    some = rows[torch.randperm(9000, generator=generator)[:1024]]
    assert error < (torch.cdist(rows, some).amin(1).square() / 9).mean()


def test_a_small_scene_has_its_own_rows_as_palette():
    rows = torch.randn(30, 9, generator=torch.Generator().manual_seed(0))
    entries, labels = palette(rows, 1024)
    assert torch.equal(entries[labels], rows)
