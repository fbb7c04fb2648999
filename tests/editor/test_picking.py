"""What a person means by a rectangle, a brush and a click."""

import torch

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.previews.level_of_detail import shown_indices
from splatgraft.editor.session.picking import Ray, Rectangle, between, first_hit, in_brush, in_rectangle, painted
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


def test_a_rectangle_takes_what_the_camera_shows_there_and_nothing_behind_it() -> None:
    # at distance 4 one unit is 25 px: x = 1 is at 125 of 200 px, z = 1 at 25 of 100 px
    means = torch.tensor([[1.0, 0, 1], [-1.0, 0, 1], [1.0, 0, -1], [0, -8.0, 0]])
    found = in_rectangle(means, camera(), Rectangle((0.6, 0.2), (0.65, 0.3)))
    assert found.tolist() == [True, False, False, False]
    assert not in_rectangle(means, camera(), Rectangle((0.0, 0.0), (1.0, 1.0)))[3]


def test_a_click_stops_at_the_first_solid_thing() -> None:
    ray = torch.tensor([0.0, -4, 0]), torch.tensor([0.0, 1, 0])
    hit = first_hit(scene([[0.0, 2, 0], [0.05, 0, 0], [1.0, -2, 0]]), *ray)
    assert hit is not None
    assert torch.allclose(hit, torch.zeros(3), atol=1e-6)  # float32 of numbers about 4
    assert first_hit(scene([[0.0, 0, 0]], logit=-3.0), *ray) is None
    assert first_hit(scene([[0.0, -8, 0]]), *ray) is None
    around = scene([[0.0, 0.5, 0], [0, 1.05, 0], [0, 2, 0]])
    assert in_brush(around, hit, 1.0).tolist() == [True, True, False]
    # a wide Gaussian is reached from aside, but not by a brush that is far from its centre
    assert in_brush(scene([[0.0, 0.15, 0], [0, 0.25, 0]], size=1.0), hit, 0.1).tolist() == [True, False]


def test_a_quick_stroke_has_no_gaps_and_passes_over_what_is_not_there() -> None:
    row = scene([[0.1 * i, 0, 0] for i in range(-10, 11) if abs(i) > 2], size=0.05)
    eye = torch.tensor([0.0, -4, 0])
    start, end = (Ray(eye, torch.tensor([x, 4.0, 0])) for x in (-1.0, 1.0))
    # two moments alone touch the ends; the whole stroke touches all
    assert int(painted(row, [start, end], size=0.05).sum()) == 4
    rays = between(start, end, size=0.05)
    assert bool(painted(row, [start, *rays], size=0.05).all())
    directions = torch.stack([torch.nn.functional.normalize(ray.direction, dim=0) for ray in [start, *rays]])
    assert (
        float((directions[1:] - directions[:-1]).norm(dim=1).max()) <= 0.25 * 0.05 / 0.97
    )  # the chord between the ends is 0.97 from the eye
    assert not painted(row, [Ray(eye, torch.tensor([0.0, 4.0, 0]))], size=0.05).any()


def test_the_last_stroke_counts() -> None:
    lifted = torch.tensor([True, True, False, False])
    strokes = add_correction(None, torch.tensor([False, True, True, False]), add=True)
    strokes = add_correction(strokes, torch.tensor([False, True, False, False]), add=False)
    assert apply_corrections(lifted, strokes).tolist() == [True, False, True, False]
    assert apply_corrections(lifted, None) is lifted


def test_thinning_keeps_what_covers_most_in_order() -> None:
    large, small = scene([[0.0, 0, 0]] * 2, size=1.0), scene([[1.0, 0, 0]] * 3)
    both = Gaussians(**{k: torch.cat([getattr(small, k), getattr(large, k)]) for k in large.__dict__})
    assert shown_indices(both, 2).tolist() == [3, 4]
    assert shown_indices(both, 5).tolist() == [0, 1, 2, 3, 4]
