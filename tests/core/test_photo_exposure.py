"""Exposure settings: the scale they give to pixel values, and what is said where they differ in a capture."""

import math

import pytest

from splatgraft.core.exposure import Exposure, describe_inconsistency, luminance_scale

SUNNY = Exposure(shutter_s=1 / 100, aperture=16.0, iso=100.0)


def test_white_paper_in_the_sun_is_not_quite_white_at_sunny_16():
    scale = luminance_scale([SUNNY], [0.5])
    assert scale is not None
    # EV 14.6: 1.2 * 25600 cd/m2; 100,000 lux on a white surface of reflectance 0.9 are 28,600
    assert scale.white == pytest.approx(30720)
    assert 0.8 < 0.9 * 100_000 / math.pi / scale.white < 1
    assert scale.mean == pytest.approx(0.5 * scale.white)


def test_settings_of_equal_exposure_have_one_exposure_value():
    assert SUNNY.ev100 == pytest.approx(Exposure(shutter_s=1 / 400, aperture=8.0, iso=100.0).ev100)
    assert SUNNY.ev100 == pytest.approx(Exposure(shutter_s=1 / 200, aperture=16.0, iso=200.0).ev100)
    twice = Exposure(shutter_s=1 / 50, aperture=16.0, iso=100.0).ev100
    assert SUNNY.ev100 is not None
    assert twice == pytest.approx(SUNNY.ev100 - 1)


def test_metered_brightness_replaces_missing_settings():
    # the APEX equation Av + Tv = Bv + Sv with Av = 8, Tv = log2(100), Sv = 5
    brightness = 8 + math.log2(100) - 5
    assert Exposure(aperture=16.0, brightness_stops=brightness).ev100 == pytest.approx(SUNNY.ev100)
    brighter = Exposure(brightness_stops=brightness, bias_stops=1.0).ev100
    assert SUNNY.ev100 is not None
    assert brighter == pytest.approx(SUNNY.ev100 - 1)
    assert Exposure(shutter_s=0.01, aperture=16.0).ev100 is None


def test_the_luminance_is_the_photos_and_needs_half_of_them():
    darker = Exposure(shutter_s=1 / 200, aperture=16.0, iso=100.0)
    # one scene photographed with half the exposure has half the pixel values
    one, both = luminance_scale([SUNNY], [0.5]), luminance_scale([SUNNY, darker], [0.5, 0.25])
    assert one is not None
    assert both is not None
    assert both.mean == pytest.approx(one.mean)
    assert luminance_scale([SUNNY, Exposure()], [0.5, 0.5]) == one
    assert luminance_scale([SUNNY, Exposure(), Exposure()], [0.5, 0.5, 0.5]) is None
    assert luminance_scale([], []) is None


def test_what_differs_is_named_with_both_ends():
    photos = [Exposure(1 / 60, 1.8, 100.0), Exposure(1 / 250, 1.8, 100.0), Exposure(1 / 125, 1.8, 100.0), Exposure()]
    line = describe_inconsistency(photos)
    assert line is not None
    assert "from 1/250 s f/1.8 ISO 100 to 1/60 s f/1.8 ISO 100, 2.1 stops apart" in line
    assert "white balance in" not in line
    assert "\n" not in line


def test_automatic_white_balance_is_named_and_counted():
    auto, fixed = (Exposure(1 / 60, 1.8, 100.0, auto_white_balance=value) for value in (True, False))
    assert "automatic white balance in 1 of 2 photos" in (describe_inconsistency([auto, fixed]) or "")
    assert "automatic white balance;" in (describe_inconsistency([auto, auto]) or "")


def test_one_step_of_the_dial_or_no_data_is_not_worth_a_line():
    fixed = [Exposure(t, 8.0, 100.0, auto_white_balance=False) for t in (1 / 160, 1 / 125)]
    assert describe_inconsistency(fixed) is None
    assert describe_inconsistency([Exposure(), Exposure()]) is None
    assert describe_inconsistency([]) is None


def test_settings_are_written_as_photographers_do():
    assert str(Exposure(2.5, 11.0, 64.0)) == "2.5 s f/11 ISO 64"
    assert str(Exposure(brightness_stops=2.0)) == "EV 7.0"
    assert str(Exposure()) == "unknown settings"
