"""Examples for learning the light: upright maps of what is known, the truth in the same cells, files."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from shapes import UP
from test_light_estimate import sunlit_scene, views
from test_true_light import SUN, day, lit_by

from splatgraft.cli import main
from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.directions import even_directions
from splatgraft.relighting.light.estimate import EstimatedLight, fit_light
from splatgraft.relighting.light.place_description import (
    COLUMNS,
    MAPS,
    NUMBERS,
    cell_directions,
    cell_solid_angles,
    describe_place,
    upright_from_world,
)
from splatgraft.training.light_examples import light_example, read_examples, write_examples

PLACE = BoundingSphere(torch.tensor([0.0, 0.0, 0.3]), 0.3)


@pytest.fixture(scope="module")
def found():
    """The estimate in a scene under a sun."""
    sun = torch.tensor([0.6 * math.cos(0.7), 0.6 * math.sin(0.7), 0.8])
    estimate = fit_light(sunlit_scene(sun, 3.0), PLACE, views())
    assert isinstance(estimate, EstimatedLight)
    return estimate


def test_cells_cover_the_sphere():
    assert float(cell_solid_angles().sum()) == pytest.approx(4 * math.pi, rel=1e-6)
    # a cosine lobe over all cells integrates to pi, whatever its axis
    directions = cell_directions().reshape(-1, 3)
    assert torch.allclose(directions.norm(dim=1), torch.ones(len(directions)), atol=1e-6)
    lobes = (even_directions(50) @ directions.T).clamp_min(0) @ cell_solid_angles().reshape(-1)
    assert torch.allclose(lobes, torch.full_like(lobes, math.pi), rtol=0.02)


@pytest.mark.parametrize("up", [UP, torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.6, 0.0, -0.8])])
def test_the_frame_is_a_rotation_whose_last_row_is_up(up):
    frame = upright_from_world(up)
    assert torch.allclose(frame @ up, torch.tensor([0.0, 0.0, 1.0]), atol=1e-6)
    assert float(torch.linalg.det(frame)) == pytest.approx(1.0, abs=1e-5)


def test_a_description_is_finite_and_names_its_parts(found):
    place = describe_place(found)
    assert place.maps.shape == (len(MAPS), 12, COLUMNS)
    assert place.numbers.shape == (len(NUMBERS),)
    assert bool(place.maps.isfinite().all())
    assert bool(place.numbers.isfinite().all())
    # the floor is seen from above and faces up: below is known, above is not; its brightness is that of lit ground
    seen = place.maps[MAPS.index("seen")]
    assert float(seen[-3:].mean()) > float(seen[:3].mean())
    weight = place.maps[MAPS.index("surfaces' weight")]
    assert float(weight[0].mean()) > float(weight[-1].mean())


def test_the_estimated_map_has_the_sun_where_the_estimate_has_it(found):
    place = describe_place(found)
    radiance = place.maps[MAPS.index("estimated")].exp2()
    frame = upright_from_world(found.evidence.up)
    middle = (radiance * cell_solid_angles())[..., None] * cell_directions()
    brightest = torch.nn.functional.normalize(middle.sum((0, 1)), dim=0) @ frame
    normals = even_directions(2000)
    wanted = normals[found.light.irradiance(normals).sum(1).argmax()]
    assert float(brightest @ wanted) > math.cos(math.radians(20))


def test_the_truth_lights_surfaces_as_the_panorama_does(found):
    panorama = day(sky=1.0, sun=1.0, radius_deg=1.0)
    example = light_example("scene/new", found, panorama, [{"direction": SUN.tolist(), "irradiance": [3.0, 2.0, 1.0]}])
    frame = upright_from_world(found.evidence.up)
    normals = even_directions(100)
    cosine = (normals @ frame.T @ cell_directions().reshape(-1, 3).T).clamp_min(0)
    power = example.truth.radiance.reshape(-1, 3) * cell_solid_angles().reshape(-1, 1)
    sun = (normals @ SUN).clamp_min(0)[:, None] * torch.tensor([3.0, 2.0, 1.0])
    wanted = lit_by(panorama, normals) + sun
    # a cell is 15 degrees wide: the sun is off by up to half its diagonal, 10 degrees
    away = (cosine @ power - wanted).abs() / wanted.max()
    assert float(away.max()) < math.sin(math.radians(10)) * 0.8
    normals = cell_directions().reshape(-1, 3)
    exact = lit_by(panorama, normals @ frame) + (normals @ frame @ SUN).clamp_min(0)[:, None] * torch.tensor(
        [3.0, 2.0, 1.0]
    )
    assert torch.allclose(example.truth.irradiance.reshape(-1, 3), exact, rtol=0.01, atol=1e-3)
    of_estimate = found.light.irradiance(normals @ frame)
    # as sources and harmonics of degree 2: the light is the same, its shape a little smoother
    ratio = example.estimated.irradiance.reshape(-1, 3) / of_estimate
    assert float((ratio.log2().abs()).mean()) < 0.15
    # all power is there: that of the panorama is four times its mean irradiance
    total = (example.truth.radiance * cell_solid_angles()[..., None]).sum()
    assert float(total) == pytest.approx(
        6.0 + 4 * float(lit_by(panorama, even_directions(4000)).mean(0).sum()), rel=0.01
    )


def test_files_hold_what_was_written(found, tmp_path):
    panorama = day(sky=1.0, sun=1e5, radius_deg=3.0)
    examples = [light_example(f"scene/{side}", found, panorama, []) for side in ("old", "new")]
    write_examples(tmp_path / "one.npz", examples)
    assert (tmp_path / "one.npz").stat().st_size < 40_000
    again = read_examples(tmp_path / "one.npz")
    assert [example.name for example in again] == ["scene/old", "scene/new"]
    assert again[0].scene == "scene"
    # half precision: 11 bits
    assert torch.allclose(again[1].place.maps, examples[1].place.maps, rtol=1e-3, atol=1e-3)
    for light in ("truth", "estimated"):
        for part in ("radiance", "irradiance"):
            values = [getattr(getattr(one[1], light), part).clamp_min(1e-6) for one in (again, examples)]
            assert torch.allclose(*values, rtol=0.02)


def test_bad_files_are_one_line(found, tmp_path):
    path = tmp_path / "bad.npz"
    path.write_bytes(b"PK not a zip")
    with pytest.raises(ValueError, match=r"bad.npz: expected examples of light as `synth lights` writes them, found"):
        read_examples(path)
    write_examples(path, [light_example("scene/old", found, day(sky=1.0, sun=1.0, radius_deg=1.0), [])])
    with np.load(path) as arrays:
        kept = dict(arrays)
    np.savez(path, **{**kept, "version": np.array(99)})
    with pytest.raises(ValueError, match=r"bad.npz: expected examples of version 3, found version 99"):
        read_examples(path)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"bad.npz: expected examples of light"):
        read_examples(path)


@pytest.mark.slow
@pytest.mark.skipif("SPLATGRAFT_BLENDER_PYTHON" not in os.environ, reason="no Python with bpy is named")
def test_synth_lights_makes_examples_and_goes_on(tmp_path, capsys):
    python = os.environ["SPLATGRAFT_BLENDER_PYTHON"]
    words = ["synth", "lights", str(tmp_path / "lights"), "--seed", "3", "--blender-python", python]
    small = ["--size", "96x64", "--views", "8", "--samples", "2", "--iterations", "150", "--mixtures", "1"]
    assert main([*words, *small, "--scenes", "1"]) == 0
    path = tmp_path / "lights" / "00000.npz"
    examples = read_examples(path)
    assert [Path(example.name).name for example in examples] == ["old", "old1", "new", "new1"]
    assert all(float(example.truth.radiance.mean()) > 0 for example in examples)
    # one room under other lights: what is seen and what is true change together
    for a, b in (examples[:2], examples[2:]):
        assert not torch.allclose(a.truth.radiance, b.truth.radiance, rtol=0.05)
        assert not torch.allclose(a.place.maps, b.place.maps, rtol=0.05)
    assert not any((tmp_path / "lights" / "work").glob("*"))
    written = path.stat().st_mtime_ns
    assert main([*words, *small, "--scenes", "1"]) == 0
    assert path.stat().st_mtime_ns == written
    capsys.readouterr()
