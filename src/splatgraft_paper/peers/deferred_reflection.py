"""3DGS-DR: Gaussians that reflect an environment, shaded after rasterising (Ye, Hou and Zhou, SIGGRAPH 2024).

Written from the publication (arXiv 2404.18454), on our renderer. Each Gaussian has a reflection strength beside its
colours; the shortest axis is its normal. Blended strength R and normal N of a pixel give its colour

    (1 - R) * colour + R * environment(direction reflected at N)

The paper extends it to insertion: the object is cut out and shown under the environment of the target, which is fitted
to the target's own photographs. No shadow is cast. What differs from the publication: the start is a finished
reconstruction, whose number of Gaussians stays, so its resets of opacity, which go with densification, are left out;
the map is a panorama instead of a cube; rates of all else are raised for shorter runs as in `reconstruction`.
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
_RATES = {"strength": 0.006, "environment": 0.05, "sh": 0.0025, "opacity_logits": 0.05, "log_scales": 0.005}
_RATES |= {"quaternions": 0.001}
"""Published learning rates; the centres stay, as they have converged."""
_HIGHER_BANDS = 1 / 20
_SHORT_POWER, _SHORT_MOST = 0.6, 8.0
"""Exponent of the published steps over ours, the factor on all rates but the environment's, and its bound."""
_PROPAGATE_EVERY, _PROPAGATE_UNTIL = 1_000, 0.8
"""Steps at the published rates between two propagations of normals, and the share of all after which there are none."""
_REFLECTS = 0.02  # strength above which a Gaussian counts as reflective when normals are propagated
_WIDER, _OPAQUE = 1.5, 0.9
"""Factor on the two longer axes of reflective Gaussians, and least opacity of all, at each propagation."""
_SABOTAGE = 0.4  # largest change of the others' band 0: their colours are spoilt so that they may turn to reflecting


@dataclass(frozen=True)
class ReflectiveScene:
    """Gaussians with reflection strengths, under an environment."""

    gaussians: Gaussians
    strength: Float[Tensor, "n"]
    """In [0, 1]."""
    environment: Float[Tensor, "h w 3"]
    """sRGB in [0, 1]; row 0 is straight up (+z), the middle column +x, and columns run towards -y."""

    def picture(self, camera: Cameras) -> Float[Tensor, "h w 3"]:
        """The scene from one camera, sRGB, not clamped above."""
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
        """The chosen Gaussians."""
        return replace(self, gaussians=self.gaussians.select(which), strength=self.strength[which])


def insert(target: ReflectiveScene, objects: Sequence[ReflectiveScene]) -> ReflectiveScene:
    """The target with objects in its frame, which reflect its environment instead of their own."""
    parts = [target, *objects]
    gaussians = concatenate([part.gaussians for part in parts])
    return ReflectiveScene(gaussians, torch.cat([part.strength for part in parts]), target.environment)


def pixel_rays(camera: Cameras) -> Float[Tensor, "h w 3"]:
    """Unit directions in the world from one camera through the centres of its pixels."""
    return F.normalize(camera.world_rays(), dim=-1)


@dataclass(frozen=True)
class FitOptions:
    """Length and size of a fit."""

    steps: int = 1_500
    """One view each."""
    panorama: tuple[int, int] = (64, 128)
    """Rows and columns of the environment."""
    seed: int = 0


def fit_reflections(start: Gaussians, photos: PosedImages, options: FitOptions = FitOptions()) -> ReflectiveScene:
    """Fit strengths and an environment, beside colours, opacities and shapes, to the photographs of a scene.

    Args:
        start: The scene as it was reconstructed from the photographs, on the CPU; the number of Gaussians stays.
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
    # two leaves of the colours: bands above 0 are slower
    own |= {"first": own["sh"][:, :1].contiguous(), "higher": own.pop("sh")[:, 1:].contiguous()}
    leaves = {name: tensor.requires_grad_() for name, tensor in own.items()}
    raised = min((_PUBLISHED_STEPS / options.steps) ** _SHORT_POWER, _SHORT_MOST)
    rates = {name: raised * rate for name, rate in _RATES.items()}
    # not raised: Adam's steps are as long where no strength reaches and the gradient is all but 0
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
            raise ValueError(f"3DGS-DR: expected a finite loss, found another at step {step}")
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
    """The scene of the leaves: strength and environment are sigmoids, as published."""
    given = {field.name: leaves[field.name] for field in fields(Gaussians) if field.name in leaves}
    sh = torch.cat([leaves["first"], leaves["higher"]], 1)
    gaussians = replace(start, sh=sh, **given)
    return ReflectiveScene(gaussians, leaves["strength"].sigmoid(), leaves["environment"].sigmoid())


@torch.no_grad()
def _propagate(leaves: dict[str, Tensor], generator: torch.Generator) -> None:
    """Let reflective Gaussians, whose normals are right, grow over their neighbours (normal propagation)."""
    reflective = leaves["strength"].sigmoid() > _REFLECTS
    scales = leaves["log_scales"]
    longer = torch.ones_like(scales).scatter(1, scales.argmin(1, keepdim=True), 0.0)
    scales += math.log(_WIDER) * longer * reflective[:, None]
    leaves["opacity_logits"].clamp_(min=math.log(_OPAQUE / (1 - _OPAQUE)))
    spoilt = _SABOTAGE * (2 * torch.rand(leaves["first"].shape, generator=generator) - 1)
    leaves["first"] += spoilt * ~reflective[:, None, None]
