"""Checks a .ply against the conventions of the original code, and takes it for another where the Gaussians say so.

The layout stores logarithms of scales, logits of opacities and quaternions wxyz, but no header states it. Each of the
three is decided by what a trained scene is: surfaces, covered by a few layers of flat, mostly opaque Gaussians.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.formats.scenes.quantized import logits_from_unit
from splatgraft.formats.scenes.scene_file import SceneFile

_SMALLEST_SCALE = 1e-30
"""World units; replaces a scale of exactly 0, since the logarithm is stored."""


@dataclass(frozen=True)
class PlausibilityOptions:
    """When a scene is read differently from the layout's word; values set by hand, `tests/formats` has both sides."""

    least_gaussians: int = 100
    """Gaussians below which the layout's word is taken."""
    least_ratio: float = 10.0
    """How much nearer to one layer linear scales must be than logarithms."""
    least_spread: float = 0.02
    """Standard deviation of opacities below which they are constant and decide nothing."""
    flat: float = 0.5
    """Smallest scale over the middle one below which a Gaussian has a normal."""
    most_normals: int = 2000
    """Flat Gaussians whose normals are compared with the surface around them."""
    neighbours: int = 8
    """Nearest centres that show the surface."""
    most_points: int = 400_000
    """Centres among which neighbours are looked for."""
    less_error: float = 0.9
    """Factor on the deviation of normals from the surface below which another order of quaternions is taken; on
    scenes of 8,000 to 25,000 Gaussians the true order has 0.74 to 0.87 of the other's."""
    least_sigmas: float = 5.0
    """Difference of the two deviations over its standard error above which it is no accident."""


def with_plausible_conventions(scene: SceneFile, *, options: PlausibilityOptions = PlausibilityOptions()) -> SceneFile:
    """The scene with logarithmic scales, logits and quaternions wxyz; its notes say what was not.

    Args:
        scene: As the layout of the original code has it.
        options: When the layout's word is not taken.
    """
    g = scene.gaussians
    finite = torch.cat([g.means, g.log_scales, g.quaternions, g.opacity_logits[:, None]], 1).isfinite().all(1)
    if int(finite.sum()) < options.least_gaussians:
        return scene
    notes = list(scene.notes)
    if _scales_are_linear(g.select(finite), options):
        g = replace(g, log_scales=g.log_scales.clamp_min(_SMALLEST_SCALE).log())
        notes.append(
            "no scale is negative, and as logarithms the Gaussians would lie in far too many layers: "
            "scales are taken as linear"
        )
    if _opacities_are_linear(g.opacity_logits[finite], options):
        g = replace(g, opacity_logits=logits_from_unit(g.opacity_logits))
        notes.append("all opacities lie in [0, 1]: they are taken as linear, and not as logits")
    errors = _normal_errors(g.select(finite), options)
    if errors is not None and _is_less(errors[1], errors[0], options):
        g = replace(g, quaternions=g.quaternions[:, [3, 0, 1, 2]])
        notes.append(
            f"as xyzw the Gaussians lie along the surfaces (squared cosine {float(errors[1].mean()):.2f}), as wxyz "
            f"less so ({float(errors[0].mean()):.2f}): quaternions are taken as xyzw"
        )
    return replace(scene, gaussians=g, notes=tuple(notes))


def _scales_are_linear(g: Gaussians, options: PlausibilityOptions) -> bool:
    """Whether linear scales give nearer to one layer of Gaussians over the scene's extent than logarithms do."""
    if bool((g.log_scales < 0).any()):
        return False
    middle = g.means.median(0).values
    extent = (g.means - middle).norm(dim=1).median()
    # a layer: the areas of all Gaussians together are that of the scene
    log_area = (g.count / extent.square()).log()
    as_logarithms = log_area + 2 * g.log_scales.median(1).values.median()
    as_linear = log_area + 2 * g.log_scales.median(1).values.median().clamp_min(_SMALLEST_SCALE).log()
    return bool(as_linear.abs() + torch.tensor(options.least_ratio).log() < as_logarithms.abs())


def _opacities_are_linear(opacities: Float[Tensor, "n"], options: PlausibilityOptions) -> bool:
    """Whether all lie in [0, 1] and differ: as logits, no Gaussian would be more than 73% opaque."""
    return bool((opacities >= 0).all() & (opacities <= 1).all() & (opacities.std() > options.least_spread))


def _is_less(errors: Float[Tensor, "m"], others: Float[Tensor, "m"], options: PlausibilityOptions) -> bool:
    """Whether the mean of `errors` is below that of `others` by enough, and not by accident."""
    difference = others - errors
    sigmas = difference.mean() / (difference.std() / len(difference) ** 0.5 + 1e-12)
    return bool((errors.mean() < options.less_error * others.mean()) & (sigmas > options.least_sigmas))


def _normal_errors(g: Gaussians, options: PlausibilityOptions) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]] | None:
    """Squared cosines between Gaussians' shortest axes and the directions to neighbours, as wxyz and as xyzw.

    Along a surface they are 0, for random axes 1/3. None where too few Gaussians are flat.
    """
    solid = g.select(g.opacity_logits > 0)
    solid = solid.select(torch.arange(0, solid.count, max(1, solid.count // options.most_points)))
    ordered = solid.log_scales.sort(1).values
    flat = (ordered[:, 0] < ordered[:, 1] + torch.tensor(options.flat).log()).nonzero()[:, 0]
    flat = flat[:: max(1, len(flat) // options.most_normals)]
    if len(flat) < options.least_gaussians:
        return None
    points = solid.means.double().numpy()
    near = np.asarray(KDTree(points).query(points[flat.numpy()], k=options.neighbours + 1)[1])
    offsets = torch.nn.functional.normalize(
        solid.means[torch.from_numpy(near[:, 1:])] - solid.means[flat][:, None], dim=-1
    )
    shortest = solid.log_scales[flat].argmin(1)
    errors = []
    for order in ([0, 1, 2, 3], [3, 0, 1, 2]):
        axes = rotation_from_quaternion(solid.quaternions[flat][:, order])
        normals = axes.gather(2, shortest[:, None, None].expand(-1, 3, 1))
        errors.append((offsets @ normals)[:, :, 0].square().mean(1))
    return errors[0], errors[1]
