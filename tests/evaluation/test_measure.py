"""Regions follow the ground truth alone; metrics are ideal for the truth itself; missing values stay missing."""

import json

import pytest
import torch

from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.evaluation.measure import ComparedView, Truth, compare, find_regions, measure
from splatgraft.evaluation.pictures import change_map, describe_change


def example_truth(shadow=0.5, seed=0):
    """Return a grey wall with an object in the middle and a shadow beside it that leaves `shadow` of linear light."""
    g = torch.Generator().manual_seed(seed)
    background = 0.5 + 0.1 * torch.rand(80, 120, 3, generator=g)
    mask = torch.zeros(80, 120)
    mask[30:50, 40:60] = 1
    ratio = torch.ones(80, 120, 1)
    ratio[50:60, 60:90] = shadow
    image = srgb_from_linear(linear_from_srgb(background) * ratio)
    image = torch.where(mask[..., None] > 0, torch.tensor([0.8, 0.3, 0.2]), image)
    return Truth(image=image, background=background, mask=mask)


def view(truth, *, copy_paste=None, result=None, held_out=False, name="a"):
    return ComparedView(
        name=name,
        held_out=held_out,
        copy_paste=truth.background if copy_paste is None else copy_paste,
        result=truth.image if result is None else result,
        background=truth.background,
        truth=truth,
    )


def test_regions_are_where_the_scene_was_made_to_change():
    regions = find_regions(example_truth())
    assert regions.object[30:50, 40:60].all()
    assert regions.object.sum() == 400
    assert regions.shadow[51:59, 62:89].all()
    assert not regions.shadow[:29].any()
    assert regions.rest[:20].all()
    assert not (regions.rest & (regions.shadow | regions.object)).any()
    assert not (regions.shadow & regions.object).any()


def test_a_faint_shadow_is_no_shadow():
    # 0.97 of the linear light is more than the 0.95 that the band asks for
    assert not find_regions(example_truth(shadow=0.97)).shadow.any()


def test_the_truth_itself_scores_perfectly():
    truth = example_truth()
    found = compare(truth.image, truth, regions=find_regions(truth), background=truth.background)
    assert found["ssim"] == pytest.approx(1, abs=1e-6)
    assert found["flip"] == found["object_flip"] == 0
    assert found["shadow_ratio_rmse"] == 0
    assert found["rest_max_change"] < 1e-6  # the example passed sRGB to linear and back
    assert found["object_psnr"] == float("inf")


def test_copy_paste_without_shadow_misses_exactly_the_shadow():
    truth = example_truth(shadow=0.5)
    pasted = torch.where(truth.mask[..., None] > 0, truth.image, truth.background)
    found = compare(pasted, truth, regions=find_regions(truth), background=truth.background)
    # ratio 1 instead of 0.5 in the core; the 3x3 mean makes the outermost rows a third or two thirds of that
    assert 0.4 < found["shadow_ratio_rmse"] < 0.5
    # the visible part is in the shadow, and FLIP blurs it over some pixels around it
    assert found["shadow_flip"] > 0.1 > 10 * found["object_flip"]
    assert found["rest_max_change"] == 0


def test_reconstruction_error_of_the_scene_does_not_count_as_shadow_error():
    truth = example_truth()
    dimmer = 0.9
    image, background = truth.image * dimmer, truth.background * dimmer
    regions = find_regions(truth)
    found = compare(image, truth, regions=regions, background=background)
    # sRGB scaled by 0.9 scales linear light by nearly 0.9^2.4 in both regions
    assert found["shadow_ratio_rmse"] < 0.01
    assert found["shadow_psnr"] < 40


def test_rest_change_is_the_worst_pixel_of_all_views():
    truth = example_truth()
    spoiled = truth.image.clone()
    spoiled[5, 5, 1] += 0.125
    content = measure([view(truth), view(truth, result=spoiled, name="b")])
    assert content["result"]["rest_max_change"] == pytest.approx(0.125, abs=1e-6)
    assert content["views"] == "all"


def test_held_out_views_are_reported_apart():
    good, bad = example_truth(seed=0), example_truth(seed=1)
    content = measure([view(good, result=good.image * 0.99, held_out=True), view(bad, result=bad.image * 0.5)])
    assert content["views"] == "held out"
    assert content["view_count"] == 1
    assert content["all_views"]["view_count"] == 2
    assert content["result"]["psnr"] > content["all_views"]["result"]["psnr"]
    assert content["result"]["psnr"] == content["per_view"][0]["result"]["psnr"]
    for block in (content, content["all_views"]):
        for which in ("copy_paste", "result"):
            assert {"object_psnr", "shadow_psnr", "shadow_ratio_rmse", "rest_max_change"} <= set(block[which])


def test_what_is_missing_is_null_and_never_filled():
    truth = example_truth(shadow=1.0)
    content = json.loads(json.dumps(measure([view(truth)]), allow_nan=False))
    assert content["result"]["shadow_psnr"] is None
    assert content["result"]["psnr"] is None  # infinite: the result is the truth
    assert "lpips" not in content["result"]
    with_distance = measure([view(truth)], perceptual=lambda a, b: (a - b).abs().mean())
    assert with_distance["result"]["lpips"] == 0


def test_change_is_described_without_truth():
    truth = example_truth(shadow=0.5)
    found = describe_change(truth.image, truth.image, truth.mask)
    assert found == {"object_brightness": 1.0, "darkened_fraction": 0.0, "brightened_fraction": 0.0}
    pasted = torch.where(truth.mask[..., None] > 0, truth.image, truth.background)
    found = describe_change(truth.image, pasted, truth.mask)
    # 10 x 30 shadowed pixels, one more row and column by the 3x3 mean, of 9600 - 400
    assert 300 / 9200 <= found["darkened_fraction"] <= 32 * 12 / 9200
    picture = change_map(truth.image, pasted)
    assert picture[55, 75, 2] > picture[55, 75, 0] + 0.3
    assert torch.allclose(picture[5, 5], picture[70, 5])
