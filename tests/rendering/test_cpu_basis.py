"""The kernels' spherical harmonics against `core.spherical_harmonics`."""

import numpy as np
import pytest
import torch

from splatgraft.core import spherical_harmonics
from splatgraft.rendering.cpu_basis import basis_and_slope


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_basis_and_slopes(degree):
    k = (degree + 1) ** 2
    directions = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    for direction in directions.double():
        found, slope = np.zeros(16), np.zeros((16, 3))
        basis_and_slope(*direction.tolist(), k, found, slope)
        expected = spherical_harmonics.basis(direction, degree)
        expected_slope = torch.autograd.functional.jacobian(lambda d: spherical_harmonics.basis(d, degree), direction)
        # the same polynomials in float64
        assert np.abs(found[:k] - expected.numpy()).max() < 1e-12
        assert np.abs(slope[:k] - expected_slope.numpy()).max() < 1e-12
