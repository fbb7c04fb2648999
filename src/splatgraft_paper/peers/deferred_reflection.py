"""3DGS-DR: Gaussians that reflect an environment, shaded after rasterising (Ye, Hou and Zhou, SIGGRAPH 2024).

Written from the publication (arXiv 2404.18454), on our renderer. Each Gaussian has a reflection strength beside its
colours, and its shortest axis is its normal. With blended strength R and normal N, the colour of a pixel is

    (1 - R) * colour + R * environment(direction reflected at N)

The paper extends the method to insertion: the object is cut out and rendered under the target's environment, which is
fitted to the target's photos. No shadow is cast. This version differs from the publication:

- It starts from a finished reconstruction and keeps the number of Gaussians, so opacity is never reset.
- The environment is a panorama instead of a cube map.
- Learning rates, except the environment's, are raised for shorter runs, as in `reconstruction`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.posed_images import PosedImages
from splatgraft.fitting import l1_dssim
from splatgraft.rendering import render
from splatgraft_paper.benchmark.true_light import sample_panorama

_FIRST_STRENGTH = 1e-3
_PUBLISHED_STEPS = 27_000  # after the first stage, which fits no reflections
# published learning rates; the means are fixed, because they have converged
_RATES = {"strength": 0.006, "environment": 0.05, "sh": 0.0025, "opacity_logits": 0.05, "log_scales": 0.005}
_RATES |= {"quaternions": 0.001}
_HIGHER_BANDS = 1 / 20  # factor on the learning rate of SH bands above 0, as published
_SHORT_POWER, _SHORT_MAX = 0.6, 8.0  # exponent and limit of the factor on rates, (published / our steps) ^ exponent
_PROPAGATE_EVERY = 1_000  # steps at the published rates between two propagations of normals
_PROPAGATE_UNTIL = 0.8  # share of all steps after which normals are not propagated
_REFLECTS = 0.02  # minimum strength of a Gaussian whose normal is propagated
_WIDER, _OPAQUE = 1.5, 0.9  # at a propagation: factor on reflective Gaussians' longer axes, minimum opacity of all
_SABOTAGE = 0.4  # maximum random change of the other Gaussians' band 0, after which they may learn to reflect


@dataclass(frozen=True)
class ReflectiveScene:
    """Gaussians with reflection strengths, under an environment."""

    gaussians: Gaussians
    strength: Float[Tensor, "n"]
    """Reflection strength, in [0, 1]."""
    environment: Float[Tensor, "h w 3"]
    """Panorama, sRGB in [0, 1]; row 0 is straight up (+z), the middle column +x, and columns run towards -y."""

    def picture(self, camera: Cameras) -> Float[Tensor, "h w 3"]:
        """Render the scene from one camera, sRGB, without an upper limit."""
        drawn = render(
            self.gaussians,
            camera,
            outputs=frozenset({"color", "normal"}),
            features=self.strength[:, None],
        )
        rays = pixel_rays(camera)
        normal, share = drawn.normal[0], drawn.features[0].clamp(0, 1)
        mirrored = rays - 2 * (rays * normal).sum(-1, keepdim=True) * normal
        return (1 - share) * drawn.color[0] + share * sample_panorama(self.environment, mirrored)

    def select(self, which: Bool[Tensor, "n"]) -> "ReflectiveScene":
        """Select some of the Gaussians."""
        return replace(self, gaussians=self.gaussians.select(which), strength=self.strength[which])


def insert(target: ReflectiveScene, objects: Sequence[ReflectiveScene]) -> ReflectiveScene:
    """Insert objects, given in the target's frame; they reflect the target's environment instead of their own."""
    parts = [target, *objects]
    gaussians = concatenate([part.gaussians for part in parts])
    return ReflectiveScene(gaussians, torch.cat([part.strength for part in parts]), target.environment)


def pixel_rays(camera: Cameras) -> Float[Tensor, "h w 3"]:
    """Compute unit directions, in world axes, from one camera through the centres of its pixels."""
    return F.normalize(camera.world_rays(), dim=-1)


@dataclass(frozen=True)
class FitOptions:
    """Length and size of a fit."""

    steps: int = 1_500
    """Steps; each renders one view."""
    panorama: tuple[int, int] = (64, 128)
    """Rows and columns of the environment's panorama."""
    seed: int = 0


def fit_reflections(start: Gaussians, photos: PosedImages, options: FitOptions = FitOptions()) -> ReflectiveScene:
    """Fit strengths, an environment, colours, opacities and shapes to the photos of a scene.

    Args:
        start: Scene reconstructed from the photos, on the CPU; the number of Gaussians does not change.
        photos: v posed images.
        options: Length and size.

    Raises:
        ValueError: The loss is not finite.
    """
    own = {
        name: getattr(start, name).detach().clone() for name in ("sh", "opacity_logits", "log_scales", "quaternions")
    }
    own["strength"] = torch.full((start.count,), math.log(_FIRST_STRENGTH / (1 - _FIRST_STRENGTH)))
    own["environment"] = torch.zeros(*options.panorama, 3)
    # the colours are split, because bands above 0 have a lower learning rate
    own |= {"first": own["sh"][:, :1].contiguous(), "higher": own.pop("sh")[:, 1:].contiguous()}
    leaves = {name: tensor.requires_grad_() for name, tensor in own.items()}
    raised = min((_PUBLISHED_STEPS / options.steps) ** _SHORT_POWER, _SHORT_MAX)
    rates = {name: raised * rate for name, rate in _RATES.items()}
    # the environment's rate is not raised, because Adam takes full steps even where the gradient is nearly 0
    rates |= {"environment": _RATES["environment"], "first": rates["sh"], "higher": rates["sh"] * _HIGHER_BANDS}
    adam = torch.optim.Adam([{"params": [leaf], "lr": rates[name]} for name, leaf in leaves.items()], eps=1e-15)
    generator = torch.Generator().manual_seed(options.seed)
    every = round(_PROPAGATE_EVERY / raised)
    images = [photos.image(index) for index in range(len(photos))]
    for step in range(options.steps):
        if step % len(images) == 0:
            order = torch.randperm(len(images), generator=generator)
        index = int(order[step % len(images)])
        loss = l1_dssim(_scene(start, leaves).picture(photos.cameras[index]), images[index])
        if not math.isfinite(float(loss.detach())):
            raise ValueError(f"3DGS-DR: expected a finite loss, found none at step {step}")
        adam.zero_grad(set_to_none=True)
        loss.backward()
        adam.step()
        if step and step % every == 0 and step < _PROPAGATE_UNTIL * options.steps:
            _propagate(leaves, generator)
    with torch.no_grad():
        found = _scene(start, leaves)
        gaussians = found.gaussians.map(Tensor.detach)
        return ReflectiveScene(gaussians, found.strength.detach(), found.environment.detach())


def _scene(start: Gaussians, leaves: dict[str, Tensor]) -> ReflectiveScene:
    """Build the scene from the optimised tensors; strength and environment are sigmoids, as published."""
    given = {field.name: leaves[field.name] for field in fields(Gaussians) if field.name in leaves}
    sh = torch.cat([leaves["first"], leaves["higher"]], 1)
    gaussians = replace(start, sh=sh, **given)
    return ReflectiveScene(gaussians, leaves["strength"].sigmoid(), leaves["environment"].sigmoid())


@torch.no_grad()
def _propagate(leaves: dict[str, Tensor], generator: torch.Generator) -> None:
    """Widen reflective Gaussians, whose normals are right, over their neighbours (normal propagation)."""
    reflective = leaves["strength"].sigmoid() > _REFLECTS
    scales = leaves["log_scales"]
    longer = torch.ones_like(scales).scatter(1, scales.argmin(1, keepdim=True), 0.0)
    scales += math.log(_WIDER) * longer * reflective[:, None]
    leaves["opacity_logits"].clamp_(min=math.log(_OPAQUE / (1 - _OPAQUE)))
    spoilt = _SABOTAGE * (2 * torch.rand(leaves["first"].shape, generator=generator) - 1)
    leaves["first"] += spoilt * ~reflective[:, None, None]
