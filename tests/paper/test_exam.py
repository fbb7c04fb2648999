"""The exam draws its scenes from its number alone, away from all known seeds, and its figures are correct."""

import math
from dataclasses import replace

import pytest
import torch
from shapes import ring, surfels

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.cameras import Cameras
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import concatenate
from splatgraft.core.similarity import Similarity
from splatgraft.evaluation import Truth
from splatgraft.relighting import Light, LightSource, SourceScene
from splatgraft.relighting.light.light import fit_ambient
from splatgraft.rendering import render
from splatgraft_paper.exam.measure import SceneResult, light_errors, make_row, measure_row, median_angle_deg
from splatgraft_paper.exam.scenes import SIZE, ExamScene, TrueView, draw_scenes, nearest_normals, seen_surface
from splatgraft_paper.exam.summary import summarize_light, summarize_row, summary_markdown
from splatgraft_paper.synthesis import benchmark, places

SUN = LightSource(direction=(0.0, 0.0, 1.0), irradiance=(3.0, 3.0, 3.0))
LIGHT = Light(sources=(SUN,), ambient=fit_ambient(torch.tensor([0.5, 0.5, 0.5])))


def test_a_number_is_an_exam():
    first = draw_scenes(7, 8)
    assert draw_scenes(7, 8) == first
    assert draw_scenes(7, 3) == first[:3]
    other = draw_scenes(8, 8)
    assert not {scene.seed for scene in first} & {scene.seed for scene in other}
    assert not {scene.object_seed for scene in first} & {scene.object_seed for scene in other}
    # all kinds, in another order
    assert sorted(scene.kind for scene in first) == sorted(places.KINDS) == sorted(scene.kind for scene in other)
    assert len({scene.name for scene in first}) == 8
    assert {scene.kind for scene in draw_scenes(7, 4, places.OUTDOORS)} == set(places.OUTDOORS)


def test_no_seed_of_an_exam_is_known():
    known = [*benchmark.SCENES, *benchmark.ROTATIONS]
    taken = {scene.seed for scene in known} | {scene.object_seed for scene in known} | set(range(10_000))
    drawn = [scene for number in range(3) for scene in draw_scenes(number, 4)]
    for scene in drawn:
        # pairs draw their objects below 2**31, and scenes from set * 100003 + number: over 20000 sets until there
        assert scene.seed >= 2**31
        assert scene.object_seed >= 2**31
        assert not {scene.seed, scene.object_seed} & taken
        assert len(benchmark.plan(scene, SIZE)[0].cameras) == SIZE.views


def scaled(light: Light, factor: float) -> Light:
    r, g, b = light.sources[0].irradiance
    sun = replace(light.sources[0], irradiance=(factor * r, factor * g, factor * b))
    return replace(light, sources=(sun,), ambient=factor * light.ambient)


def test_errors_of_a_light_of_double_strength_are_one_stop_of_level():
    assert light_errors(LIGHT, LIGHT) == {"rms": 0, "level": 0, "tint": 0, "direction_deg": pytest.approx(0, abs=0.05)}
    double = light_errors(scaled(LIGHT, 2.0), LIGHT)
    # float32
    assert double["level"] == pytest.approx(1, abs=1e-5)
    assert double["rms"] == pytest.approx(1, abs=1e-5)
    assert double["tint"] == pytest.approx(0, abs=1e-5)


def test_a_turned_light_is_off_by_its_angle():
    angle = math.radians(30)
    turned = replace(LIGHT, sources=(replace(SUN, direction=(math.sin(angle), 0.0, math.cos(angle))),))
    # 10,000 directions are 2 degrees apart, so both are off by at most 1.5
    assert light_errors(turned, LIGHT)["direction_deg"] == pytest.approx(30, abs=3)


def test_a_red_light_has_a_tint_and_no_level():
    gray, red = fit_ambient(torch.tensor([0.5, 0.5, 0.5])), fit_ambient(torch.tensor([0.75, 0.5, 0.25]))
    errors = light_errors(Light((), red), Light((), gray))
    assert errors["level"] == pytest.approx(0, abs=1e-5)
    wanted = math.sqrt((math.log2(1.5) ** 2 + math.log2(0.5) ** 2) / 3)
    assert errors["tint"] == pytest.approx(wanted, abs=1e-5)


def test_what_lies_inside_of_an_object_is_not_its_surface():
    around = even_directions(20_000)
    ball, core = torch.cat([0.2 * around, around], 1), torch.cat([0.17 * around[::2], around[::2]], 1)
    inner = torch.cat([0.19 * around, -around], 1)  # the inner wall of a hollow ball
    seen = seen_surface(torch.cat([ball, core, inner]), ring(12))
    # the cameras are above the middle: a cap around the ball's lower pole is unseen
    assert 0.7 * len(ball) < len(seen) < len(ball)
    assert float(seen[:, :3].norm(dim=1).min()) > 0.199


def test_true_normals_are_those_of_the_nearest_surface():
    around = even_directions(5000)
    points = 0.9 * even_directions(100)
    found = nearest_normals(points, torch.cat([around, around], 1))
    chosen = torch.ones(100, dtype=torch.bool)
    # 5000 directions are about 3 degrees apart
    angle = median_angle_deg(found, torch.nn.functional.normalize(points, dim=1), chosen)
    assert angle is not None
    assert angle < 3
    assert median_angle_deg(found, found, ~chosen) is None


@pytest.mark.long
def test_fitted_colours_make_the_true_shadow_in_views_they_were_not_fitted_to():
    x, y = torch.meshgrid(torch.linspace(-1, 1, 41), torch.linspace(-1, 1, 41), indexing="ij")
    points = torch.stack([x.flatten(), y.flatten(), torch.zeros(x.numel())], 1)
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(len(points), 3)
    in_shadow = (points[:, 0] > 0.2) & (points[:, 0] < 0.9) & (points[:, 1].abs() < 0.3)
    # a case that the transfer cannot know: a shadow beside the object, under a light that makes none there
    bright, dark = (surfels(points, up, width=0.04, srgb=shade) for shade in (0.6, 0.3))
    shadowed = replace(bright, sh=torch.where(in_shadow[:, None, None], dark.sh, bright.sh))
    around = even_directions(300)
    thing = surfels(0.15 * around + torch.tensor([0.0, 0.0, 0.15]), around, width=0.02, srgb=0.5)
    place = Similarity(1.0, torch.eye(3), torch.zeros(3))
    composite = Composite(bright, (PlacedObject(thing, place),), torch.zeros(bright.count, dtype=torch.bool))
    cameras, even = ring(16), replace(LIGHT, sources=())

    is_thing = torch.cat([torch.zeros(bright.count, 1), torch.ones(thing.count, 1)])

    def view(camera: Cameras) -> TrueView:
        image, background = (render(s, camera).color[0].clamp(0, 1) for s in (concatenate([shadowed, thing]), bright))
        mask = render(concatenate([bright, thing]), camera, features=is_thing).features
        return TrueView(camera, Truth(image, background, mask[0, ..., 0]), background)

    fitted = [i for i in range(16) if i % 4]
    scene = ExamScene(
        name="floor",
        composite=composite,
        cameras=cameras[fitted],
        source=SourceScene(bright, cameras, light=even),
        views=tuple(view(camera) for camera in cameras[::4]),
        fitted_views=tuple(view(camera) for camera in cameras[fitted]),
        new_light=even,
        old_light=even,
        normals=None,
    )
    rows = {row: make_row(row, scene)[0] for row in ("paste", "true-lights", "fitted")}
    error = {row: measure_row(made, scene.views)["shadow"] for row, made in rows.items()}
    assert error["fitted"] < 0.3 * error["paste"]
    assert error["true-lights"] > 0.7 * error["paste"]


def result(name, *rows, light=None) -> SceneResult:
    keys = ("object", "whole", "shadow")
    named = zip(("paste", "transfer"), rows, strict=True)
    return SceneResult(name, {row: dict(zip(keys, values, strict=True)) for row, values in named}, light or {})


def errors(level, rms):
    return {"rms": rms, "level": level, "tint": 0.1, "direction_deg": 10.0}


def test_the_summary_is_the_mean_over_scenes_against_pasting():
    results = [
        result("a", (14.0, 24.0, 0.4), (17.0, 25.0, 0.1), light={"new": errors(-0.5, 0.6), "old": errors(0.25, 0.2)}),
        result("b", (10.0, 20.0, 0.2), (11.0, 19.0, 0.15), light={"new": errors(1.0, 1.0), "old": None}),
        result("c", (12.0, 22.0, None), (12.5, 22.5, None)),
    ]
    found = summarize_row("transfer", results)
    assert found.scenes == 3
    assert found.object_gain == pytest.approx((3 + 1 + 0.5) / 3)
    # shares of 75% and 25%; the third scene has no shadow
    assert found.shadow_removed == pytest.approx(0.5)
    assert found.worse == 1
    light = summarize_light(results)
    rms = light["irradiance, RMS over normals, stops"]
    assert rms is not None
    assert (rms.mean, rms.worst) == pytest.approx((0.6, 1.0))
    ratio = light["level of the ratio of new to old light, stops"]
    assert ratio is not None
    assert ratio.mean == pytest.approx(0.75)
    assert summarize_row("gain", results).object_gain is None
    text = summary_markdown(results)
    assert "| transfer | the transfer, everything estimated | +1.50 | 50% | 1 of 3 |" in text


def test_a_result_survives_its_file():
    one = result("a", (14.0, 24.0, None), (17.0, 25.0, 0.1), light={"new": errors(-0.5, 0.6), "old": None})
    assert SceneResult.from_json(one.as_json()) == one
