"""TranSplat's diffuse path: light transfer by the ratio of two irradiances at each Gaussian's normal, no shadow.

Yu et al., TranSplat (ICCP 2026, arXiv 2503.22676), written from the publication because its code is not public:

1. Render the environments at the old and the new place from the two scenes.
2. Expand both in spherical harmonics of degree 2.
3. Multiply colours by the ratio of new to old irradiance; factors of a radially symmetric reflection cancel in it.

The specular path (higher bands in the reflection domain) and self-shadowing are left out.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core import spherical_harmonics
from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting import SourceScene
from splatgraft.relighting.light.panorama import NoLight, Panorama, panorama_at
from splatgraft.relighting.normals import estimate_normals
from splatgraft.relighting.shading import apply_gain
from splatgraft.runtime.note import Note

_DEGREE = 2  # the clamped cosine has no band 3, and little above (Ramamoorthi and Hanrahan 2001)


def relight_by_irradiance_ratio(
    composite: Composite, *, sources: Sequence[SourceScene | None]
) -> tuple[Composite, tuple[Note, ...]]:
    """Multiply the linear colours of every object by the ratio of the irradiances at its new and its old place.

    An object keeps its captured colours, with a warning, if its source is None or no light is found at a place.
    """
    if len(sources) != len(composite.objects):
        raise ValueError(f"relight: expected {len(composite.objects)} source scenes, found {len(sources)}")
    scene = composite.target.select(~composite.erased)
    recolored, notes = [], []
    for number, (placed, source) in enumerate(zip(composite.objects, sources, strict=True), start=1):
        found = "its source scene is not known." if source is None else _relit(placed, source, scene)
        if isinstance(found, str):
            recolored.append(placed.gaussians)
            notes.append(Note(f"Object {number}: {found} It is pasted with its captured colours.", "warning"))
        else:
            recolored.append(found)
            notes.append(Note(f"Object {number}: lit by the ratio of irradiances."))
    return composite.with_object_colors(tuple(recolored)), tuple(notes)


def project(panorama: Panorama, degree: int = _DEGREE) -> Float[Tensor, "k 3"]:
    """Project a panorama's linear radiance on spherical harmonics; uncaptured directions get the mean of the others."""
    weight = panorama.alpha * panorama.solid_angles
    mean = (panorama.radiance * weight[..., None]).sum((0, 1, 2)) / weight.sum().clamp_min(1e-12)
    filled = panorama.radiance * panorama.alpha[..., None] + mean * (1 - panorama.alpha[..., None])
    values = spherical_harmonics.basis(panorama.directions, degree)
    return torch.einsum("fhwk,fhwc,fhw->kc", values, filled, panorama.solid_angles)


def irradiance_of(coefficients: Float[Tensor, "k 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Compute linear RGB irradiance at unit `normals`: radiance convolved with the clamped cosine, by band."""
    bands = torch.tensor([math.pi] + [2 * math.pi / 3] * 3 + [math.pi / 4] * 5).to(coefficients)
    return spherical_harmonics.basis(normals, _DEGREE) @ (bands[:, None] * coefficients)


def irradiance_ratio(target: Float[Tensor, "n 3"], source: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Compute the factor on linear colours, at most 10 either way."""
    # expansions may be near 0 or negative; limits set by hand, since the publication states none
    floored = [x.clamp_min(0.05 * float(x.mean().clamp_min(1e-8))) for x in (target, source)]
    return (floored[0] / floored[1]).clamp(1 / 10.0, 10.0)


def _relit(placed: PlacedObject, source: SourceScene, scene: Gaussians) -> Gaussians | str:
    """Return the object with its new colours, or the reason why it has none."""
    if placed.gaussians.count == 0:
        return "it is empty."
    panoramas = {
        "source": panorama_at(source.gaussians, bounding_sphere(placed.gaussians)),
        "target": panorama_at(scene, bounding_sphere(placed.in_target())),
    }
    for where, panorama in panoramas.items():
        if isinstance(panorama, NoLight):
            return f"in the {where}: {panorama.reason}"
    old, new = (project(p) for p in panoramas.values() if isinstance(p, Panorama))
    normals = source.normals
    if normals is None:
        normals = estimate_normals(placed.gaussians, source.cameras).vectors
    turned = normals @ placed.target_from_object.rotation.to(normals).T
    ratio = irradiance_ratio(irradiance_of(new, turned), irradiance_of(old, normals))
    return replace(placed.gaussians, sh=apply_gain(placed.gaussians, ratio).sh)
