"""Per-view errors: known tints and flows are recovered."""

import pytest
import torch
import torch.nn.functional as F

from splatgraft.consolidation.view_errors import ViewError, no_view_error, refine


def texture(height: int = 96, width: int = 128, seed: int = 0) -> torch.Tensor:
    """Return smooth blobs of about 8 px in [0.2, 0.8], so that bicubic sampling is accurate."""
    noise = torch.rand(1, 3, height // 8, width // 8, generator=torch.Generator().manual_seed(seed))
    return 0.2 + 0.6 * F.interpolate(noise, (height, width), mode="bicubic")[0].permute(1, 2, 0).clamp(0, 1)


def spoilt_by(view_error: ViewError, image: torch.Tensor) -> torch.Tensor:
    """Return an image whose correction by `view_error` is about `image`: a negated small flow is nearly its inverse."""
    return ViewError(flow=-view_error.flow, log_gain=-view_error.log_gain).correct(image)


def test_nothing_is_found_where_nothing_is_wrong():
    image = texture()
    found = refine(no_view_error(image), image, image)
    assert not found.flow.any()
    assert not found.log_gain.any()


def test_a_known_tint_and_flow_are_found():
    image = texture()
    generator = torch.Generator().manual_seed(1)
    clean = no_view_error(image)
    # constant over the picture, plus a small variation
    flow = torch.tensor([0.6, -0.4]) + 0.1 * torch.randn(clean.flow.shape, generator=generator)
    gain = torch.tensor([0.06, -0.04, 0.0]) + 0.01 * torch.randn(clean.log_gain.shape, generator=generator)
    true = ViewError(flow=flow, log_gain=gain)
    spoilt = spoilt_by(true, image)
    found = clean
    for _ in range(4):
        found = refine(found, spoilt, image)
    # the ridge shrinks, and knots share pixels: a tolerance of a third of the size, far below a missed error
    assert float((found.flow - flow).abs().mean()) < 0.17
    assert float((found.log_gain - gain).abs().mean()) < 0.02
    error = lambda picture: float((picture - image).abs().mean())  # noqa: E731
    assert error(found.correct(spoilt)) < 0.35 * error(spoilt)


@pytest.mark.parametrize(("height", "width"), [(11, 17), (16, 200), (5, 5)])
def test_small_images_have_grids_too(height, width):
    image = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(2))
    found = refine(no_view_error(image), image, image.flip(0))
    assert found.correct(image).shape == image.shape
    assert bool(torch.isfinite(found.correct(image)).all())
