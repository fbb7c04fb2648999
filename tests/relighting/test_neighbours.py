"""Nearest neighbours against all pairs."""

import pytest
import torch

from splatgraft.relighting.nearest_neighbours import nearest_neighbours


@pytest.mark.parametrize("n", [1, 2, 9, 700])
def test_neighbours_are_the_nearest(n):
    generator = torch.Generator().manual_seed(n)
    # dense clusters, strays far away and repeated points, as captures have them
    points = torch.randn(n, 3, generator=generator) ** 5
    points[n // 2 :] *= 1e-3
    points[: n // 5] = points[n // 5 : 2 * (n // 5)]
    found = nearest_neighbours(points, count=16)
    assert found.shape == (n, min(16, n))
    away = (points[:, None] - points[None]).norm(dim=-1)
    expected = away.sort(1).values[:, :16]
    # float32: two parts in 1e7 of the coordinates, up to 1e3
    assert torch.allclose(away.gather(1, found.long()).sort(1).values, expected, atol=1e-4)
    assert all(len(set(row)) == len(row) for row in found.tolist())


def test_no_points_have_no_neighbours():
    assert nearest_neighbours(torch.zeros(0, 3), count=16).shape == (0, 0)
