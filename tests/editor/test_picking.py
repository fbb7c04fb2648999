"""Selection by rectangle, click and brush, and clicked points in photos."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import read_upright
from splatgraft.core.prompts import ViewPrompt
from splatgraft.editor.photo_view import PhotoView, prompt_of, with_click
from splatgraft.editor.picking import (
    Ray,
    brush_selection,
    first_surface_hit,
    in_brush,
    in_rectangle,
    interpolate_rays,
)
from splatgraft.editor.relit_preview import largest_coverage_indices
from splatgraft.segmentation import add_correction, apply_corrections


def scene(means: list[list[float]], *, size: float = 0.1, logit: float = 3.0) -> Gaussians:
    n = len(means)
    return Gaussians(
        means=torch.tensor(means),
        log_scales=torch.full((n, 3), size).log(),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        opacity_logits=torch.full((n,), logit),
        sh=torch.zeros(n, 1, 3),
    )


def camera() -> Cameras:
    pose = look_at(torch.tensor([[0.0, -4.0, 0.0]]), torch.zeros(3), torch.tensor([0.0, 0, 1]))
    return pinhole(pose, 100.0, width=200, height=100)


def test_a_rectangle_selects_centres_that_project_into_it_and_none_behind_the_camera() -> None:
    # at distance 4 one unit is 25 px: x = 1 is at 125 of 200 px, z = 1 at 25 of 100 px
    means = torch.tensor([[1.0, 0, 1], [-1.0, 0, 1], [1.0, 0, -1], [0, -8.0, 0]])
    found = in_rectangle(means, camera(), (0.65, 0.2), (0.6, 0.3))
    assert found.tolist() == [True, False, False, False]
    assert not in_rectangle(means, camera(), (0.0, 0.0), (1.0, 1.0))[3]


def test_a_ray_stops_at_the_first_opaque_surface() -> None:
    ray = torch.tensor([0.0, -4, 0]), torch.tensor([0.0, 1, 0])
    hit = first_surface_hit(scene([[0.0, 2, 0], [0.05, 0, 0], [1.0, -2, 0]]), *ray)
    assert hit is not None
    assert torch.allclose(hit, torch.zeros(3), atol=1e-6)  # float32 of numbers about 4
    assert first_surface_hit(scene([[0.0, 0, 0]], logit=-3.0), *ray) is None
    assert first_surface_hit(scene([[0.0, -8, 0]]), *ray) is None
    around = scene([[0.0, 0.5, 0], [0, 1.05, 0], [0, 2, 0]])
    assert in_brush(around, hit, 1.0).tolist() == [True, True, False]
    # a wide Gaussian is touched from its side, but not by a small brush far from its centre
    assert in_brush(scene([[0.0, 0.15, 0], [0, 0.25, 0]], size=1.0), hit, 0.1).tolist() == [True, False]


def test_a_fast_stroke_has_no_gaps_and_ignores_empty_space() -> None:
    row = scene([[0.1 * i, 0, 0] for i in range(-10, 11) if abs(i) > 2], size=0.05)
    eye = torch.tensor([0.0, -4, 0])
    start, end = (Ray(eye, torch.tensor([x, 4.0, 0])) for x in (-1.0, 1.0))
    # the two end rays alone select the ends; the interpolated stroke selects all
    assert int(brush_selection(row, [start, end], size=0.05).sum()) == 4
    rays = interpolate_rays(start, end, size=0.05)
    assert bool(brush_selection(row, [start, *rays], size=0.05).all())
    directions = torch.stack([torch.nn.functional.normalize(ray.direction, dim=0) for ray in [start, *rays]])
    assert (
        float((directions[1:] - directions[:-1]).norm(dim=1).max()) <= 0.25 * 0.05 / 0.97
    )  # the chord between the ends is 0.97 from the eye
    assert not brush_selection(row, [Ray(eye, torch.tensor([0.0, 4.0, 0]))], size=0.05).any()


def test_later_corrections_override_earlier_ones() -> None:
    lifted = torch.tensor([True, True, False, False])
    strokes = add_correction(None, torch.tensor([False, True, True, False]), add=True)
    strokes = add_correction(strokes, torch.tensor([False, True, False, False]), add=False)
    assert apply_corrections(lifted, strokes).tolist() == [True, False, True, False]
    assert apply_corrections(lifted, None) is lifted


def test_level_of_detail_keeps_the_largest_coverage_in_order() -> None:
    large, small = scene([[0.0, 0, 0]] * 2, size=1.0), scene([[1.0, 0, 0]] * 3)
    both = Gaussians(**{k: torch.cat([getattr(small, k), getattr(large, k)]) for k in large.__dict__})
    assert largest_coverage_indices(both, 2).tolist() == [3, 4]
    assert largest_coverage_indices(both, 5).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("canvas", [(800, 300), (300, 800), (640, 480)])
def test_a_click_on_a_drawn_point_is_that_point(canvas: tuple[int, int]) -> None:
    view = PhotoView((320, 200), canvas)
    photo = np.full((100, 160, 3), 128, np.uint8)
    photo[18:23, 123:128] = (0, 255, 0)  # around 250, 40 of the photo, of half its size
    drawn = view.drawn(photo).astype(int)
    assert drawn.shape == (canvas[1], canvas[0], 3)
    rows, columns = ((drawn[..., 1] > 180) & (drawn[..., 0] < 120)).nonzero()
    place = (columns.mean() + 0.5) / canvas[0], (rows.mean() + 0.5) / canvas[1]
    # to two pixels of the canvas and one of the small photo
    assert view.pixel_at(place) == pytest.approx((251, 41), abs=2 / view.scale + 2)
    assert view.place_of(250 / 320, 40 / 200) == pytest.approx(place, abs=0.02)
    assert view.pixel_at(view.place_of(0.3, 0.6)) == pytest.approx((96, 120))
    # the canvas is larger than the photo on one pair of sides, unless it has its shape
    assert view.pixel_at((0.5, 0.5)) == pytest.approx((160, 100))
    if canvas == (800, 300):
        assert view.pixel_at((0.01, 0.5)) is None
    if canvas == (300, 800):
        assert view.pixel_at((0.5, 0.99)) is None


def test_a_photo_is_shown_upright_with_its_own_size(tmp_path: Path) -> None:
    pixels = np.zeros((60, 100, 3), np.uint8)
    pixels[:, :50, 0] = 255
    tags = Image.Exif()
    tags[274] = 6  # the camera was turned: a viewer turns the picture by 90 degrees to the right
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=tags)
    found, size = read_upright(tmp_path / "a.png", 50)
    assert size == (60, 100)
    assert found.shape == (50, 30, 3)
    # the left side is now above
    assert found[:20, :, 0].min() > 250
    assert found[30:, :, 0].max() < 5


def test_clicks_add_and_remove_points() -> None:
    one = with_click(None, "a/b.jpg", (10.04, 20.0), on_object=True, longer_side=1000)
    two = with_click(one, "a/b.jpg", (500.0, 20.0), on_object=False, longer_side=1000)
    assert prompt_of(two, "a/b.jpg").inside[0].tolist() == pytest.approx([10.0, 20.0])
    assert len(prompt_of(two, "a/b.jpg").outside) == 1
    # near an existing one, of either kind
    three = with_click(two, "a/b.jpg", (495.0, 25.0), on_object=True, longer_side=1000)
    assert len(prompt_of(three, "a/b.jpg").outside) == 0
    assert with_click(one, "a/b.jpg", (11.0, 19.0), on_object=False, longer_side=1000) is None
    # a file by hand may call the photo by its stem, and has a rectangle
    by_hand = {"b": ViewPrompt(inside=torch.tensor([[1.0, 2.0]]), box=(0.0, 0.0, 9.0, 9.0))}
    kept = with_click(by_hand, "a/b.jpg", (2.0, 2.0), on_object=True, longer_side=1000)
    assert kept is not None
    assert list(kept) == ["b"]
    assert kept["b"].box == (0.0, 0.0, 9.0, 9.0)
