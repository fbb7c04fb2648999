"""Bands that show the new light's reflections on an object: matt colours by their ratio of light, plus the lobes.

Colours are evaluated in directions over the sphere and projected on harmonics of degree 3; directions behind the
surface take the value of their image in front of it, so that no edge lies at the horizon.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import srgb_from_linear
from splatgraft.relighting.shading.gain import apply_gain
from splatgraft.relighting.shading.materials import Materials, lobe_radiance
from splatgraft.relighting.shading.reflected_light import ReflectedLight

_CHUNK = 4096
"""Gaussians at a time; bounds memory."""
_VIEWS = 96
"""Directions over the sphere: three times as many as are needed to integrate products of degree 3 without error."""
_BRIGHTEST = 1.5
"""Linear; brighter reflections are clipped, which keeps bands from ringing over the whole object."""


def gloss_bands(
    gaussians: Gaussians,
    normals: Float[Tensor, "n 3"],
    materials: Materials,
    light: ReflectedLight,
    *,
    shade: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 16 3"]:
    """Coefficients that are added after shading and after the old bands are taken out; 0 where nothing is glossy.

    Args:
        gaussians: The object.
        normals: Unit, outward.
        materials: Of the object.
        light: At the new place, in the units of the old one.
        shade: Factor on linear rgb of what is matt.
    """
    degree = spherical_harmonics.MAX_DEGREE
    views = even_directions(_VIEWS)
    project = spherical_harmonics.basis(views, degree) * (4 * math.pi / _VIEWS)
    out = torch.zeros(gaussians.count, project.shape[1], 3)
    for start in range(0, gaussians.count, _CHUNK):
        rows = slice(start, start + _CHUNK)
        glossy = materials.glossy[rows]
        if not bool(glossy.any()):
            continue
        facing = normals[rows][:, None]
        towards = -(views * facing).sum(-1)
        # both a direction and its image in the tangent plane are mirrored to the same side
        cosine = towards.abs()
        in_front = views + (towards - cosine)[..., None] * facing
        lobe = lobe_radiance(materials, rows, light, in_front + 2 * cosine[..., None] * facing, cosine)
        linear = (materials.matt[rows] * shade[rows])[:, None] + lobe
        srgb = srgb_from_linear(linear.clamp(0, _BRIGHTEST))
        bands = torch.einsum("vk,nvc->nkc", project, srgb - 0.5)
        bands[:, 0] -= apply_gain(gaussians.select(torch.arange(gaussians.count)[rows]), shade[rows]).sh[:, 0]
        out[rows] = bands * glossy[:, None, None]
    return out
