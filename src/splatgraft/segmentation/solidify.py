"""Makes an extracted object opaque: fits it alone to its masked photographs over random backgrounds.

In its own capture an object may be half transparent and still look right, since the Gaussians behind it were fitted
together with it; at its outline, neighbouring Gaussians may hide those that stick out. Both become visible in another
scene. Only an opaque object inside its mask matches the photographs over every background.
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


@dataclass(frozen=True)
class SolidifyOptions:
    """Length and learning rates of the fit; values set by hand."""

    iterations: int = 400
    """Steps, one view each."""
    opacity_rate: float = 0.05
    """Of Adam, logits per step."""
    color_rate: float = 0.0025
    """Of Adam, band 0 per step; a twentieth for the others (as 3DGS)."""
    scale_rate: float = 0.005
    """Of Adam, natural logarithm per step."""
    position_rate: float = 2e-4
    """Of Adam, per step, over the object's radius."""
    rotation_ratio: float = 0.2
    """Learning rate of the quaternions over that of the scales."""
    occluder_distance: float = 0.25
    """Distance in front of the object, over its extent, from which something else occludes it."""
    margin_px: int = 12
    """Border of the image windows around the object."""
    seed: int = 0
    """Of the views and backgrounds drawn."""


@dataclass(frozen=True)
class _CroppedView:
    """One view, cropped to the object."""

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
    views = [
        view
        for camera, (image, mask) in zip(cameras, photographs, strict=True)
        if (view := _cropped_view(scene, selection, camera, image, mask, options)) is not None
    ]
    if not views:
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
            {"params": [leaves["quaternions"]], "lr": options.rotation_ratio * options.scale_rate},
            {"params": [leaves["opacity_logits"]], "lr": options.opacity_rate},
            {"params": [base], "lr": options.color_rate},
            {"params": [higher], "lr": options.color_rate / 20},
        ],
        eps=1e-15,
    )
    generator = torch.Generator().manual_seed(options.seed)
    for step in range(options.iterations):
        view = views[int(torch.randint(len(views), (1,), generator=generator))]
        background = torch.rand(3, generator=generator)
        fitted = replace(chosen, **leaves, sh=torch.cat([base, higher], 1))
        drawn = render(fitted, view.camera, options=RenderOptions(background=tuple(background.tolist()))).color
        target = view.mask * view.image + (1 - view.mask) * background.to(view.image)
        loss = (view.weight * (drawn[0] - target).abs()).mean()
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


def _cropped_view(
    scene: Gaussians,
    selection: Bool[Tensor, "n"],
    camera: Cameras,
    image: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"],
    options: SolidifyOptions,
) -> _CroppedView | None:
    """The view cropped to where the object shows; None where the mask is empty."""
    chosen = scene.select(selection)
    object_alone = render(chosen, camera, outputs=frozenset({"depth"}))
    rest = render(scene.select(~selection), camera, outputs=frozenset({"depth"}))
    extent = float((chosen.means.quantile(0.95, dim=0) - chosen.means.quantile(0.05, dim=0)).norm())
    in_front = rest.depth[0] < object_alone.depth[0] - options.occluder_distance * extent
    occluded = in_front & (rest.alpha[0] > 0.5)
    hidden = occluded & (object_alone.alpha[0] > 0.5) & (mask.to(occluded.device) < 0.5)
    shown = (mask > 0.5) | ((object_alone.alpha[0] > 0.05) & ~hidden).to(mask.device)
    if not bool((mask > 0.5).any()):
        return None
    rows, columns = torch.nonzero(shown.any(1))[:, 0], torch.nonzero(shown.any(0))[:, 0]
    top, left = max(int(rows[0]) - options.margin_px, 0), max(int(columns[0]) - options.margin_px, 0)
    bottom = min(int(rows[-1]) + 1 + options.margin_px, image.shape[0])
    right = min(int(columns[-1]) + 1 + options.margin_px, image.shape[1])
    device = scene.device
    return _CroppedView(
        camera=camera.cropped([(left, top, right, bottom)]),
        image=image[top:bottom, left:right].to(device),
        mask=mask[top:bottom, left:right, None].to(device),
        weight=(~hidden[top:bottom, left:right, None]).float(),
    )
