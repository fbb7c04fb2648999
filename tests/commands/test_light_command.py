"""`light`: its environment map and lamps light a sphere like the known light; conventions; a project's light."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
import torch
from shapes import ring, sunlit_scene
from torch import Tensor

import splatgraft as sg
from splatgraft.cli import main
from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.directions import even_directions
from splatgraft.core.similarity import Similarity
from splatgraft.folders.composite_folder import read_composite
from splatgraft.formats import write_cameras, write_gaussians
from splatgraft.relighting.light.environment import EnvironmentLight
from splatgraft.relighting.light.light import Light, LightSource, light_from_json

SUN = torch.nn.functional.normalize(torch.tensor([-0.39, 0.67, 0.8]), dim=0)
STRENGTH = 3.0
"""Irradiance of the sun on a surface that faces it, over the sky's on the floor."""
FLOOR = 0.15 * (1 + STRENGTH * float(SUN[2]))
"""Linear value of the lit floor's pixels, for the albedo of `sunlit_scene`."""
CAPTURE_FROM_WORLD = torch.tensor([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]])
"""Rotation into a capture with y down, turned so that its .glb opens in Blender as the world."""


def pixels(height: int) -> tuple[Tensor, Tensor]:
    """Return directions and solid angles of a map as in `--help`: top +z, middle column +x, to the right -y."""
    rows, columns = (torch.arange(n, dtype=torch.float64) + 0.5 for n in (height, 2 * height))
    up, right = math.pi * (0.5 - rows / height)[:, None], math.pi * (columns / height - 1)[None]
    directions = torch.stack([up.cos() * right.cos(), -up.cos() * right.sin(), up.sin() + 0 * right], -1)
    return directions.float(), (up.cos() * (math.pi / height) ** 2).expand(height, 2 * height).float()


def read_hdr(path: Path) -> Tensor:
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return torch.from_numpy(found[..., ::-1].copy())


def lit_by_map(radiance: Tensor, normals: Tensor) -> Tensor:
    """Return irradiance (n 3) on planes."""
    directions, angles = (values.flatten(0, 1) for values in pixels(len(radiance)))
    return ((normals @ directions.T).clamp_min(0) * angles) @ radiance.flatten(0, 1)


def lit_by_lamps(path: Path, normals: Tensor) -> Tensor:
    total = torch.zeros(len(normals), 3)
    for lamp in json.loads(path.read_text())["sources"]:
        cosine = (normals @ torch.tensor(lamp["direction"])).clamp_min(0)
        total += cosine[:, None] * torch.tensor(lamp["irradiance"])
    return total


@pytest.fixture(scope="module")
def sunlit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder that `light` wrote for a scene under a sun and an even sky that no camera saw."""
    folder = tmp_path_factory.mktemp("sunlit")
    turned = Similarity(1.0, CAPTURE_FROM_WORLD, torch.zeros(3))
    write_gaussians(folder / "target.ply", turned.gaussians(sunlit_scene(SUN, STRENGTH)))
    write_cameras(folder / "transforms.json", turned.cameras(ring()))
    at = ["--at", *(str(v) for v in turned.points(torch.tensor([0.0, 0.0, 0.3])).tolist()), "--radius", "0.3"]
    words = ["light", str(folder / "target.ply"), "--cameras", str(folder / "transforms.json"), *at]
    assert main([*words, "--out", str(folder / "light.hdr"), "--height", "128"]) == 0
    return folder


def test_a_sphere_is_lit_as_by_the_known_sun_and_sky(sunlit: Path):
    normals = even_directions(2000)
    normals = normals[normals[:, 2] > 0]
    by_map, by_lamps = lit_by_map(read_hdr(sunlit / "light.hdr"), normals), lit_by_lamps(sunlit / "light.json", normals)
    found, by_sun = (by_map + by_lamps).mean(1), STRENGTH * math.pi * (normals @ SUN).clamp_min(0)
    # the sky over the horizon, the lit floor below it
    known = by_sun + math.pi * (1 + normals[:, 2]) / 2 + FLOOR * math.pi * (1 - normals[:, 2]) / 2
    # normals lie 4.5 degrees apart, and the sun is found within 3
    assert float(normals[found.argmax()] @ normals[known.argmax()]) > math.cos(math.radians(8))
    # the level of the light is free, because the floor's albedo is unknown; 0.1 of the sun's share may be the sky's
    assert float((found / found.max() - known / known.max()).abs().max()) < 0.1
    top = normals[:, 2].argmax()
    share = float(by_lamps[top].mean() / found[top])
    # 0.1 as in relighting/test_light.py: Gaussians mix lit and shaded floor at the edges of shadows; and 0.01, because
    # the map's irradiance is within 3% of what harmonics of degree 2 give there
    assert share == pytest.approx(float(by_sun[top] / (by_sun[top] + math.pi)), abs=0.11)


def test_the_map_shows_the_scene_s_own_pixels_below_its_horizon_and_no_lamp(sunlit: Path):
    radiance, (directions, _) = read_hdr(sunlit / "light.hdr"), pixels(128)
    assert (sunlit / "light.hdr").read_bytes().startswith(b"#?RADIANCE\n")
    assert radiance.shape == (128, 256, 3)
    # linear radiance of the lit floor; near the place a ball takes 2% of the sky, and alpha is not quite 1
    floor = radiance[directions[..., 2] < -0.3].median(0).values
    assert floor.tolist() == pytest.approx([FLOOR] * 3, rel=0.03)
    # the sun of the lamps would be above 1000: its 0.3 degrees have 9e-5 steradians
    assert float(radiance.max()) < 10
    assert lit_by_lamps(sunlit / "light.json", SUN[None]).mean() > 3


def test_the_map_alone_lights_a_sphere_as_map_and_lamps(sunlit: Path, tmp_path: Path):
    text, beside = (sunlit / "light.json").read_text(), read_hdr(sunlit / "light.hdr")
    turn = torch.tensor(json.loads(text)["world_from_capture"])
    sg.save_hdr(tmp_path / "alone.hdr", EnvironmentLight(light_from_json(text), beside, turn).with_lamps())
    normals = even_directions(2000)
    alone = lit_by_map(read_hdr(tmp_path / "alone.hdr"), normals)
    both = lit_by_map(beside, normals) + lit_by_lamps(sunlit / "light.json", normals)
    # a disc of radius r adds sin(r) / 4 of the lamp at its own horizon, which is 1% for 2 degrees; 8 bits are 0.4%
    assert float((alone / both - 1).abs().max()) < 0.03
    assert float((lit_by_map(beside, normals) / both).min()) < 0.7
    with pytest.raises(ValueError, match=r"light\.png: expected a name that ends in \.hdr"):
        sg.save_hdr(tmp_path / "light.png", beside)


@pytest.mark.parametrize("height", [16, 64, 512])
@pytest.mark.parametrize("towards", [(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.6, 0.48, 0.64), (0.0, -0.8, -0.6)])
@pytest.mark.parametrize(("radius_deg", "strength"), [(0.27, 1.0), (0.27, 100.0), (5.0, 1.0), (90.0, 1.0)])
def test_a_lamp_in_the_map_has_its_energy_at_every_size_and_place(
    height: int, towards: tuple[float, float, float], radius_deg: float, strength: float
):
    source = LightSource(towards, (0.2 * strength, strength, 0.5 * strength), radius_deg)
    found = EnvironmentLight(Light((source,), torch.zeros(9, 3)), torch.zeros(height, 2 * height, 3), torch.eye(3))
    radiance = found.with_lamps()
    # rounding of float32 in a sum of at most 524,288 pixels
    assert lit_by_map(radiance, torch.tensor([towards]))[0].tolist() == pytest.approx(source.irradiance, rel=1e-3)
    # radiance of a disc one degree wide, whose edge cuts pixels of 0.35 degrees; half floats end at 65,504
    assert float(radiance.max()) < min(65_504, 1.1 * strength / (math.pi * math.radians(0.5) ** 2))
    # no wider than the lamp, the disc that half floats need (1.3 degrees) or a pixel, and the soft edge of a pixel
    widest = max(radius_deg, 1.4, 90 / height) + 90 / height
    is_lit, cosine = radiance[..., 1] > 0, pixels(height)[0] @ torch.tensor(towards)
    assert float(cosine[is_lit].min()) > math.cos(math.radians(widest)) - 1e-6


def test_the_lamps_can_be_given_back_in_the_axes_of_the_capture(sunlit: Path):
    text = (sunlit / "light.json").read_text()
    back = light_from_json(text)
    towards = CAPTURE_FROM_WORLD @ SUN
    assert float(torch.tensor(back.sources[0].direction) @ towards) > math.cos(math.radians(3))
    # six decimals of coefficients and directions
    normals = even_directions(50)
    plain = json.loads(text)
    del plain["world_from_capture"]
    in_world = light_from_json(json.dumps(plain)).irradiance(normals)
    assert torch.allclose(back.irradiance(normals @ CAPTURE_FROM_WORLD.T), in_world, atol=1e-4)
    for broken in ([[1, 0, 0], [0, 1, 0]], [[1, 0, 0], [0, 1, 0], [0, 0, -1]], [[1, 0, 0], [0, 1, 0], [0, 0.5, 1]]):
        with pytest.raises(ValueError, match=r"my\.json: world_from_capture: expected"):
            light_from_json(json.dumps(plain | {"world_from_capture": broken}), name="my.json")


@pytest.mark.long
def test_at_a_project_s_object_it_is_the_light_that_relight_finds(copy_project: Callable[[], Path], capsys):
    project = copy_project()
    out = project / "light.hdr"
    words = {"target": "target/scene/scene.ply", "placement": "composite/placement.json", "out": "again"}
    words |= {"cameras": "target/capture/transforms.json"}
    given = [word for name, path in words.items() for word in (f"--{name}", str(project / path))]
    assert main(["relight", *given, "--fitted-views", "0"]) == 0
    assert main(["light", str(project), "--out", str(out), "--frame", "capture", "--height", "16"]) == 0
    assert out.with_suffix(".json").read_text() == (project / "again" / "light.json").read_text()
    # and Python's
    composite = read_composite(project / words["target"], project / words["placement"])
    place, cameras = bounding_sphere(composite.objects[0].in_target()), sg.read_cameras(project / words["cameras"])
    at, scene = place.center.tolist(), composite.target
    found = sg.light_at(scene, cameras, at, radius=place.radius, height=16)
    assert sg.light_to_json(found.light) == out.with_suffix(".json").read_text()
    up = found.map_from_capture.T[:, 2]
    assert torch.allclose(up, estimate_up(cameras), atol=1e-6)
    with pytest.raises(ValueError, match=r"place: expected one with light around it, found \[1000\.0, 0\.0, 0\.0\]"):
        sg.light_at(scene, cameras, [1000.0, 0.0, 0.0])
    # a light given to the project is used: its ambient light is the map
    light = json.loads(out.with_suffix(".json").read_text())
    ambient = [[0.5 / 0.28209479] * 3, *[[0.0] * 3] * 8]
    (project / "given.json").write_text(json.dumps(light | {"sources": [], "ambient_sh": ambient}))
    file = project / "project.toml"
    file.write_text(file.read_text().replace('light = "off"', 'given_light = "given.json"'))
    assert main(["light", str(file), "--out", str(out), "--height", "16"]) == 0
    # 8 bits of mantissa
    assert torch.allclose(read_hdr(out), torch.tensor(0.5), rtol=1 / 256)
    # with the lamps in the map there is one file
    sun = {"direction": [0.0, 0.6, 0.8], "irradiance": [3.0, 2.0, 1.0], "angular_radius_deg": 2.0}
    (project / "given.json").write_text(json.dumps(light | {"sources": [sun], "ambient_sh": ambient}))
    alone = project / "alone.hdr"
    assert main(["light", str(file), "--out", str(alone), "--lamps", "map", "--frame", "capture"]) == 0
    assert not alone.with_suffix(".json").exists()
    lit = lit_by_map(read_hdr(alone), torch.tensor([sun["direction"]]))[0]
    # 0.5 of an even sky gives half of pi; 8 bits of mantissa
    assert lit.tolist() == pytest.approx([0.5 * math.pi + v for v in sun["irradiance"]], rel=0.01)
    capsys.readouterr()
    for wrong, line in (
        (["--out", "light.png"], "--out: expected a file that ends in .hdr, found light.png"),
        (["--height", "1"], "--height: expected 16 to 4096 rows, found 1"),
        (["--radius", "0"], "--radius: expected a number above 0, found 0"),
        (["--placement", str(project / "none.json")], "--at: expected x y z, or a placed object in"),
    ):
        assert main(["light", str(project), *wrong]) == 2
        assert line in capsys.readouterr().err
    assert main(["light", str(project / "object" / "object.ply")]) == 2
    assert "--cameras: expected the capture that" in capsys.readouterr().err
    assert main(["light", str(project / "views")]) == 2
    assert "views: expected a project, a scene or a folder with scene.ply" in capsys.readouterr().err
