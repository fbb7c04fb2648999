"""Lifting of 2D masks to one mask value per Gaussian.

A view's mask m is modelled as the blend W f of the values f. The closed form is the weighted average W^T m / W^T 1
(FlashSplat, ECCV 2024, for one bit; Splat Feature Solver, ICLR 2026, for any feature). The paper's method
(Sec. 4) trains a logit per Gaussian with binary cross-entropy on its blend.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import RenderOptions, ViewOperator, view_operator
from splatgraft.runtime.progress import Progress, silent

_SEEN = 1e-3  # sum of blending weights over all views, pixels, above which a Gaussian counts as seen


@dataclass(frozen=True)
class LiftOptions:
    """Method of lifting, and settings of the paper's training."""

    method: Literal["closed_form", "bce"] = "closed_form"
    """Weighted average, or the paper's training, which starts from the weighted average."""
    iterations: int = 10_000
    """Steps of `bce`, one view each."""
    learning_rate: float = 0.05
    """Learning rate of Adam in `bce`, logits per step."""
    seed: int = 0
    """Seed of the order of views in `bce`."""


def lift_masks(
    gaussians: Gaussians,
    cameras: Cameras,
    masks: Sequence[Float[Tensor, "_ _"]],
    options: LiftOptions = LiftOptions(),
    *,
    progress: Progress = silent,
) -> Float[Tensor, "n"]:
    """Lift masks of images to one number per Gaussian, its share in the masked object.

    `closed_form` computes the share of the Gaussian's blending weight that falls inside the masks. `bce` trains a logit
    per Gaussian (paper, Sec. 4) and returns its sigmoid. The paper's threshold of 0.75 applies to both.

    Args:
        gaussians: n Gaussians.
        cameras: v cameras, on the device of `gaussians`.
        masks: v masks (h, w) in [0, 1], 1 inside the object, each of its camera's size.
        options: The method and the rates of `bce`.
        progress: Called with steps done, steps in all and a short text.

    Returns:
        The feature in [0, 1]; 0 for a Gaussian that no view sees.
    """
    if not masks or len(masks) != len(cameras):
        raise ValueError(f"masks: expected one for each of {len(cameras)} cameras, found {len(masks)}")
    total = torch.zeros(gaussians.count, 2, device=gaussians.device)
    operators: list[ViewOperator] = []
    for index, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        progress(index, len(masks), "lifting masks")
        if mask.shape != (camera.height, camera.width):
            raise ValueError(
                f"mask of {camera.names[0]}: expected {camera.width}x{camera.height} pixels, found "
                f"{mask.shape[1]}x{mask.shape[0]}"
            )
        operator = view_operator(gaussians, camera, RenderOptions())
        total += weight_inside(operator, mask.to(gaussians.device))
        if options.method == "bce":  # the closed form keeps one operator at a time to save memory
            operators.append(operator)
    progress(len(masks), len(masks), "lifting masks")
    share = share_inside(total)
    if options.method == "closed_form":
        return share
    return _trained(share, operators, masks, options, progress).where(total[:, 1] > _SEEN, 0.0)


def weight_inside(operator: ViewOperator, mask: Float[Tensor, "h w"]) -> Float[Tensor, "n 2"]:
    """Compute the blending weight of each Gaussian inside the mask and in the whole view, pixels."""
    return operator.blend_transpose(torch.stack([mask, torch.ones_like(mask)], -1))


def share_inside(total: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
    """Compute the share of each Gaussian's blending weight inside the masks, given sums over views; 0 if unseen."""
    inside, seen = total[:, 0], total[:, 1]
    return (inside / seen.clamp_min(_SEEN)).clamp(0, 1).where(seen > _SEEN, 0.0)


def _trained(
    start: Float[Tensor, "n"],
    operators: Sequence[ViewOperator],
    masks: Sequence[Tensor],
    options: LiftOptions,
    progress: Progress,
) -> Float[Tensor, "n"]:
    logits = torch.logit(start, eps=0.01)[:, None].clone().requires_grad_()
    optimizer = torch.optim.Adam([logits], lr=options.learning_rate, eps=1e-15)
    targets = [mask.to(start)[..., None] for mask in masks]
    generator = torch.Generator().manual_seed(options.seed)
    order: list[int] = []
    for step in range(options.iterations):
        order = order or torch.randperm(len(targets), generator=generator).tolist()
        view = order.pop()
        loss = torch.nn.functional.binary_cross_entropy_with_logits(operators[view].blend(logits), targets[view])
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if step % 50 == 0:
            progress(step, options.iterations, f"cross-entropy {loss.item():.4f}")
    progress(options.iterations, options.iterations, "features trained")
    return logits.detach()[:, 0].sigmoid()
