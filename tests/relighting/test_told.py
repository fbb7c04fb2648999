"""What is known of an object's capture (its light, its normals) is used as it is, instead of an estimate."""

from dataclasses import replace

import pytest
import torch
from shapes import ring, surfels

from splatgraft.core.composite import Composite, PlacedObject
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians, empty
from splatgraft.core.similarity import Similarity
from splatgraft.relighting import Light, LightSource, SourceScene, relight
from splatgraft.relighting.light.light import fit_ambient
from splatgraft.relighting.prepared_object import prepare_object

COUNT = 2000
QUARTER = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
LIGHT = Light(
    sources=(LightSource(direction=(0.6, 0.0, 0.8), irradiance=(3.0, 2.5, 2.0), name="sun"),),
    ambient=fit_ambient(torch.tensor([0.4, 0.5, 0.6])),
)


def ball() -> Gaussians:
    around = even_directions(COUNT)
    return surfels(0.3 * around, around, width=0.012)


def cameras():
    return ring(8, size=(64, 48))


def prepared(source: SourceScene, rotation=QUARTER):
    placed = PlacedObject(ball(), Similarity(1.0, rotation, torch.tensor([0.0, 0.0, 1.0])))
    return prepare_object(placed, source, cameras(), source_light=source.light, light=LIGHT, number=1)


def test_a_told_light_is_turned_with_the_object_and_needs_no_scene():
    lighting = prepared(SourceScene(empty(), cameras(), light=LIGHT)).source_lighting
    assert lighting is not None
    # a quarter turn about z takes (0.6, 0, 0.8) to (0, 0.6, 0.8); float32
    assert lighting.light.sources[0].direction == pytest.approx((0.0, 0.6, 0.8), abs=1e-6)
    assert lighting.light.sources[0].irradiance == LIGHT.sources[0].irradiance


def test_an_object_told_to_have_stood_in_the_same_light_keeps_its_colours():
    sky = surfels(20 * even_directions(500), -even_directions(500), width=0.1)
    at = Similarity(1.0, torch.eye(3), torch.zeros(3))
    composite = Composite(sky, (PlacedObject(ball(), at),), torch.zeros(sky.count, dtype=torch.bool))
    relit = relight(composite, cameras(), sources=(SourceScene(empty(), cameras(), light=LIGHT),), light=LIGHT)
    shade = relit.shade[relit.is_object]
    # both irradiances come from the same samples; float32
    assert torch.allclose(shade, torch.ones_like(shade), atol=1e-4)
    assert any("as given" in note.text for note in relit.report[1:])


def test_between_two_told_lights_the_level_changes_in_full():
    sky = surfels(20 * even_directions(500), -even_directions(500), width=0.1)
    at = Similarity(1.0, torch.eye(3), torch.zeros(3))
    composite = Composite(sky, (PlacedObject(ball(), at),), torch.zeros(sky.count, dtype=torch.bool))
    sources = (SourceScene(empty(), cameras(), light=LIGHT),)
    dimmed = Light(
        sources=tuple(replace(s, irradiance=tuple(0.25 * x for x in s.irradiance)) for s in LIGHT.sources),
        ambient=0.25 * LIGHT.ambient,
    )
    relit = relight(composite, cameras(), sources=sources, light=dimmed)
    shade = relit.shade[relit.is_object]
    # both irradiances come from the same samples; float32
    assert torch.allclose(shade, torch.full_like(shade, 0.25), rtol=1e-3)


def test_told_normals_are_turned_with_the_object_and_believed():
    told = even_directions(COUNT).flip(1)
    normals = prepared(SourceScene(empty(), cameras(), light=LIGHT, normals=told)).normals
    # float32
    assert torch.allclose(normals.vectors, told @ QUARTER.T, atol=1e-6)
    assert bool((normals.confidence == 1).all())
    assert bool(normals.seen.all())


def test_told_normals_must_be_those_of_the_object():
    with pytest.raises(ValueError, match="expected 2000 normals, found 7"):
        prepared(SourceScene(empty(), cameras(), normals=even_directions(7)))


def test_a_transfer_tells_what_it_found_of_each_object():
    sky = surfels(20 * even_directions(500), -even_directions(500), width=0.1)
    at = Similarity(1.0, QUARTER, torch.zeros(3))
    composite = Composite(sky, (PlacedObject(ball(), at),), torch.zeros(sky.count, dtype=torch.bool))
    relit = relight(composite, cameras(), sources=(SourceScene(empty(), cameras(), light=LIGHT),), light=LIGHT)
    (found,) = relit.prepared
    assert found.normals.vectors.shape == (COUNT, 3)
    assert found.source_lighting is not None
    assert found.source_lighting.light.sources[0].direction == pytest.approx((0.0, 0.6, 0.8), abs=1e-6)
