"""Harmonisers: `none` keeps the prior bit by bit, `reinhard` moves the object alone, names are checked."""

import pytest
import torch

from splatgraft.harmonization import HarmonizerInputs, make_harmonizer


def example_view(seed=0):
    g = torch.Generator().manual_seed(seed)
    background = 0.3 + 0.2 * torch.rand(40, 60, 3, generator=g)
    mask = torch.zeros(40, 60)
    mask[12:28, 20:40] = 1
    composite = torch.where(mask[..., None] > 0, torch.rand(40, 60, 3, generator=g), background)
    return HarmonizerInputs(
        composite=composite,
        background=background,
        mask=mask,
        depth=torch.ones(40, 60),
        normal=torch.zeros(40, 60, 3),
        prior=composite * 0.9,
    )


def test_none_is_the_prior():
    view = example_view()
    assert torch.equal(make_harmonizer("none").harmonize(view).image, view.prior)


def test_reinhard_changes_the_object_alone_and_brings_it_near_its_surroundings():
    view = example_view()
    image = make_harmonizer("reinhard").harmonize(view).image
    inside = view.mask > 0.5
    assert torch.equal(image[~inside], view.prior[~inside])
    # the grey uniform background spans 0.3-0.5: matched log statistics put the mean within a tenth of that of 0.4
    assert (image[inside].mean(0) - 0.4).abs().max() < 0.04
    # and its deviation, 0.2/sqrt(12) = 0.058, replaces the object's of 0.26
    assert image[inside].std(0).max() < 0.09


def test_reinhard_without_an_object_is_the_prior():
    view = example_view()
    nothing = HarmonizerInputs(**{**view.__dict__, "mask": torch.zeros(40, 60)})
    assert torch.equal(make_harmonizer("reinhard").harmonize(nothing).image, view.prior)


def test_unknown_name_lists_the_known():
    with pytest.raises(ValueError, match="none, reinhard, found 'magic'"):
        make_harmonizer("magic")


def test_harmonizers_without_weights_keep_size_and_range():
    view = example_view(1)
    for name in ("none", "reinhard"):
        image = make_harmonizer(name).harmonize(view).image
        assert image.shape == view.composite.shape
        assert image.min() >= 0
        assert image.max() <= 1
