"""The level by the photos' exposure beside that by the light: equal where both agree, and said where they do not."""

import math
from dataclasses import replace

import pytest
import torch
from shapes import ring, surfels

from splatgraft.core.composite import Composite, PlacedObject
from splatgraft.core.directions import even_directions
from splatgraft.core.exposure import LuminanceScale
from splatgraft.core.gaussians import empty
from splatgraft.core.similarity import Similarity
from splatgraft.relighting import Light, Relit, SourceScene, relight
from splatgraft.relighting.light.light import fit_ambient
from splatgraft.relighting.report import describe_level


def even(radiance: float) -> Light:
    return Light(sources=(), ambient=fit_ambient(torch.full((3,), radiance)))


@pytest.fixture(scope="module")
def relit() -> Relit:
    """A ball from even light of radiance 0.4 in light of radiance 0.2, both in units of their captures' white."""
    sky = surfels(20 * even_directions(500), -even_directions(500), width=0.1)
    ball = surfels(0.3 * even_directions(500), even_directions(500), width=0.02)
    at = PlacedObject(ball, Similarity(1.0, torch.eye(3), torch.zeros(3)))
    composite = Composite(sky, (at,), torch.zeros(sky.count, dtype=torch.bool))
    cameras = ring(4, size=(64, 48))
    return relight(composite, cameras, sources=(SourceScene(empty(), cameras, light=even(0.4)),), light=even(0.2))


def test_agreeing_levels_are_told_in_stops_and_lux(relit: Relit):
    # the target's white is 8 times the source's, and half as much of it arrives: 2 stops by the light and the photos
    found = describe_level(relit, target=LuminanceScale(800.0, 200.0), source=LuminanceScale(100.0, 50.0))
    assert len(found) == 1
    assert "the new place is 2.0 stops brighter than the old one" in found[0].text
    assert "light on the object 2.0 stops brighter" in found[0].text
    assert "differ" not in found[0].text
    assert not found[0].in_doubt
    # even radiance L gives pi L of illuminance on a convex body; the ball's own Gaussians take some of it
    words = found[0].text.replace(",", "").split()
    there, old = (float(words[i - 1].lstrip("(")) for i, word in enumerate(words) if word in ("lux", "at"))
    assert there == pytest.approx(math.pi * 0.2 * 800, rel=0.15)
    assert there == pytest.approx(4 * old, rel=0.05)


def test_a_large_difference_and_a_darker_place_are_said(relit: Relit):
    (line,) = describe_level(relit, target=LuminanceScale(800.0, 10.0), source=LuminanceScale(100.0, 40.0))
    assert "the new place is 2.0 stops darker than the old one" in line.text
    assert "They differ by 4.0 stops" in line.text
    assert line.in_doubt
    assert "sun" not in line.text


def test_light_beyond_the_suns_is_said(relit: Relit):
    (line,) = describe_level(relit, target=LuminanceScale(8e5, 2e5), source=LuminanceScale(1e5, 5e4))
    assert "more than sun and sky give" in line.text


def test_without_a_source_light_or_with_black_photos_nothing_is_compared(relit: Relit):
    scale = LuminanceScale(100.0, 20.0)
    unknown = replace(relit, prepared=(replace(relit.prepared[0], source_lighting=None),))
    assert describe_level(unknown, target=scale, source=scale) == ()
    assert describe_level(relit, target=scale, source=LuminanceScale(100.0, 0.0)) == ()
