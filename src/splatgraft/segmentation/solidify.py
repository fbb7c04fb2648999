"""Makes an extracted object look whole where its scene is gone. Knows nothing about files and how it was chosen.

In its own capture an object may be half transparent and still look right, since what shines through was fitted along
with it; at its outline it may rely on neighbours to hide what sticks out. Cut out and put elsewhere, both show. Here
the object alone is fitted to its masked photographs over random backgrounds, which only a solid object can match.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import RenderOptions, render
from splatgraft.runtime.progress import Progress, silent

_MARGIN_PX = 12


@dataclass(frozen=True)
class SolidifyOptions:
    """How long and how freely the object may change."""

    iterations: int = 400
    """Steps, one view each."""
    opacity_rate: float = 0.05
    """Of Adam, logits per step."""
    color_rate: float = 0.0025
    """Of Adam, band 0 per step; a twentieth for the others (as 3DGS)."""
    scale_rate: float = 0.005
    """Of Adam, natural logarithm per step."""
    position_rate: float = 2e-4
    """Of Adam, parts of the object's radius per step."""
    seed: int = 0
    """Of views and backgrounds."""


@dataclass(frozen=True)
class _Sight:
    """One view, cut down to where the object is."""

    camera: Cameras
    image: Float[Tensor, "h w 3"]
    mask: Float[Tensor, "h w 1"]
    weight: Float[Tensor, "h w 1"]


def solidify_object(
    scene: Gaussians,
    selection: Bool[Tensor, "n"],
    cameras: Cameras,
    photographs: Sequence[tuple[Float[Tensor, "_ _ 3"], Float[Tensor, "_ _"]]],
    *,
    options: SolidifyOptions = SolidifyOptions(),
    progress: Progress = silent,
) -> Gaussians:
    """Fit an extracted object alone to its masked images over random backgrounds, so that it becomes opaque.

    Pixels outside the mask where the object is hidden by something in front of it are not used.

    Args:
        scene: n Gaussians of the whole scene.
        selection: Which of them are the object's.
        cameras: v cameras, on the device of `scene`.
        photographs: The image (h, w, 3), sRGB in [0, 1], and the object mask (h, w) of each camera.
        options: Steps and rates.
        progress: Called with steps done, steps in all and a short text.

    Returns:
        The object's Gaussians, changed in every field.

    Raises:
        ValueError: All masks are empty.
    """
    chosen = scene.select(selection)
    sights = [
        sight
        for camera, (image, mask) in zip(cameras, photographs, strict=True)
        if (sight := _sight(scene, selection, camera, image, mask)) is not None
    ]
    if not sights:
        raise ValueError("object: expected a mask with some of it inside, found all empty")
    radius = float((chosen.means - chosen.means.mean(0)).norm(dim=1).quantile(0.9))
    leaves = {
        name: getattr(chosen, name).detach().clone().requires_grad_()
        for name in ("means", "log_scales", "quaternions", "opacity_logits")
    }
    base = chosen.sh[:, :1].detach().clone().requires_grad_()
    higher = chosen.sh[:, 1:].detach().clone().requires_grad_()
    optimizer = torch.optim.Adam(
        [
            {"params": [leaves["means"]], "lr": options.position_rate * radius},
            {"params": [leaves["log_scales"]], "lr": options.scale_rate},
            {"params": [leaves["quaternions"]], "lr": 0.2 * options.scale_rate},
            {"params": [leaves["opacity_logits"]], "lr": options.opacity_rate},
            {"params": [base], "lr": options.color_rate},
            {"params": [higher], "lr": options.color_rate / 20},
        ],
        eps=1e-15,
    )
    generator = torch.Generator().manual_seed(options.seed)
    for step in range(options.iterations):
        sight = sights[int(torch.randint(len(sights), (1,), generator=generator))]
        background = torch.rand(3, generator=generator)
        fitted = replace(chosen, **leaves, sh=torch.cat([base, higher], 1))
        drawn = render(fitted, sight.camera, options=RenderOptions(background=tuple(background.tolist()))).color
        wanted = sight.mask * sight.image + (1 - sight.mask) * background.to(sight.image)
        loss = (sight.weight * (drawn[0] - wanted).abs()).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if step % 20 == 0:
            progress(step, options.iterations, f"making the object solid, loss {loss.item():.4f}")
    progress(options.iterations, options.iterations, "the object is solid")
    return replace(
        chosen,
        **{name: leaf.detach() for name, leaf in leaves.items()},
        sh=torch.cat([base, higher], 1).detach(),
    )


def _sight(
    scene: Gaussians,
    selection: Bool[Tensor, "n"],
    camera: Cameras,
    image: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"],
) -> _Sight | None:
    """None where the mask is empty."""
    chosen = scene.select(selection)
    serialized = render(chosen, camera, outputs=frozenset({"depth"}))
    rest = render(scene.select(~selection), camera, outputs=frozenset({"depth"}))
    extent = float((chosen.means.quantile(0.95, dim=0) - chosen.means.quantile(0.05, dim=0)).norm())
    before = (rest.depth[0] < serialized.depth[0] - 0.25 * extent) & (rest.alpha[0] > 0.5)
    hidden = before & (serialized.alpha[0] > 0.5) & (mask.to(before.device) < 0.5)
    shown = (mask > 0.5) | ((serialized.alpha[0] > 0.05) & ~hidden).to(mask.device)
    if not bool((mask > 0.5).any()):
        return None
    rows, columns = torch.nonzero(shown.any(1))[:, 0], torch.nonzero(shown.any(0))[:, 0]
    top, left = max(int(rows[0]) - _MARGIN_PX, 0), max(int(columns[0]) - _MARGIN_PX, 0)
    bottom = min(int(rows[-1]) + 1 + _MARGIN_PX, image.shape[0])
    right = min(int(columns[-1]) + 1 + _MARGIN_PX, image.shape[1])
    intrinsics = camera.intrinsics.clone()
    intrinsics[0, :2, 2] -= torch.tensor([left, top]).to(intrinsics)
    device = scene.device
    return _Sight(
        camera=replace(camera, intrinsics=intrinsics, sizes=torch.tensor([[right - left, bottom - top]])),
        image=image[top:bottom, left:right].to(device),
        mask=mask[top:bottom, left:right, None].to(device),
        weight=(~hidden[top:bottom, left:right, None]).float(),
    )
