"""What the compact network is shown of a view, and how its answer becomes a picture. Knows no network.

Every factor is laid onto the composite's own pixels at full resolution: texture is multiplied, never made up.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.images import linear_from_srgb
from splatgraft.harmonization.interface import HarmonizerInputs

CHANNELS = 16
SH_COUNT = 9
GRID_BINS = 4
_LIFT = 0.004
"""Linear light below which a ratio says nothing: 1/255 of white."""
_MOST = 3.0
"""Largest log ratio of the prior."""
_PICTURES = ("composite", "background", "mask", "log_ratio", "depth", "normal")


@dataclass(frozen=True)
class View:
    """A batch of views in linear light, channels first, at any one size."""

    composite: Float[Tensor, "b 3 h w"]
    """Linear, as pasted."""
    background: Float[Tensor, "b 3 h w"]
    """Linear, without the object."""
    mask: Float[Tensor, "b 1 h w"]
    log_ratio: Float[Tensor, "b 3 h w"]
    """Of the prior over the composite, see `log_ratio_of`; 0 where there is no prior."""
    depth: Float[Tensor, "b 1 h w"]
    """Log of depth over the object's median depth, clamped to [-2, 2]; 2 where nothing is."""
    normal: Float[Tensor, "b 3 h w"]
    """Unit, in the camera's frame: right, down, away; 0 where nothing is."""
    prior_confidence: Float[Tensor, "b"]
    """In the prior, in [0, 1]."""

    def channels(self) -> Float[Tensor, "b 16 h w"]:
        """What the network sees."""
        b, _, h, w = self.mask.shape
        prior_confidence = self.prior_confidence[:, None, None, None].expand(b, 1, h, w)
        there = (self.normal.abs().sum(1, keepdim=True) > 0).to(self.mask)
        lights = [_compressed(self.composite), _compressed(self.background), self.log_ratio]
        return torch.cat([*lights, 2 * self.mask - 1, self.depth, there, self.normal, prior_confidence], 1)

    def prior(self) -> Float[Tensor, "b 3 h w"]:
        """What the light transfer made, linear."""
        return ((self.composite + _LIFT) * self.log_ratio.exp() - _LIFT).clamp_min(0)

    def to(self, device: torch.device) -> "View":
        """The same on a device."""
        return View(**{name: getattr(self, name).to(device) for name in (*_PICTURES, "prior_confidence")})

    def resized(self, height: int, width: int) -> "View":
        """The same at another size; averaged where it gets smaller."""

        def to(x: Tensor) -> Tensor:
            return F.interpolate(x, size=(height, width), mode="bilinear", antialias=True, align_corners=False)

        return View(**{name: to(getattr(self, name)) for name in _PICTURES}, prior_confidence=self.prior_confidence)


@dataclass(frozen=True)
class Answer:
    """What the network says of a view; at its own, lower resolution."""

    object_follow: Float[Tensor, "b 1 i j"]
    """By how much the prior's log ratio is believed above 1, on the object."""
    object_gain: Float[Tensor, "b 3 i j"]
    """Log gain on the object."""
    object_sh: Float[Tensor, "b 9 3"]
    """Log gain on the object by its normal, in spherical harmonics of degree 2."""
    object_grid: Float[Tensor, "b 12 l p q"]
    """Bilateral grid (Chen et al. 2007) of affine colour maps, as a change: 3 rows of 3 factors and an offset."""
    scene_follow: Float[Tensor, "b 1 i j"]
    """As `object_follow`, off the object."""
    scene_gain: Float[Tensor, "b 3 i j"]
    """Log gain off the object: shadow and bounce."""
    scene_added: Float[Tensor, "b 3 i j"]
    """Linear light added off the object: reflections."""
    log_error: Float[Tensor, "b 1 i j"]
    """Log of the error that the network expects of itself, sRGB."""

    def whole(self) -> "Answer":
        """The same in float32."""
        return Answer(**{name: tensor.float() for name, tensor in vars(self).items()})


def log_ratio_of(prior: Float[Tensor, "*n"], composite: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Log of prior over composite, both linear; safe in the dark."""
    return ((prior + _LIFT) / (composite + _LIFT)).log().clamp(-_MOST, _MOST)


def composed(view: View, answer: Answer) -> Float[Tensor, "b 3 h w"]:
    """The harmonised view, linear, at the size of `view`. With an answer of zeros it is the prior."""
    size = view.mask.shape[-2:]

    def up(x: Tensor) -> Tensor:
        return F.interpolate(x, size=size, mode="bilinear", align_corners=False)

    mask = view.mask
    by_normal = torch.einsum("bkhw,bkc->bchw", _harmonics(view.normal), answer.object_sh)
    on_object = (1 + up(answer.object_follow)) * view.log_ratio + up(answer.object_gain) + by_normal
    on_scene = (1 + up(answer.scene_follow)) * view.log_ratio + up(answer.scene_gain)
    total = mask * on_object + (1 - mask) * on_scene
    lit = (view.composite + _LIFT) * total.clamp(-4, 4).exp() - _LIFT
    lit = lit + mask * _affine(lit, answer.object_grid) + (1 - mask) * up(answer.scene_added)
    return lit.clamp_min(0)


def view_of(inputs: HarmonizerInputs) -> View:
    """One view as a batch of one."""
    lights = [
        linear_from_srgb(picture.clamp(0, 1)).permute(2, 0, 1)[None]
        for picture in (inputs.composite, inputs.background, inputs.prior)
    ]
    turn = inputs.camera_from_world
    normal = inputs.normal if turn is None else inputs.normal @ turn.T
    return View(
        composite=lights[0],
        background=lights[1],
        mask=inputs.mask.clamp(0, 1)[None, None],
        log_ratio=log_ratio_of(lights[2], lights[0]),
        depth=relative_depth(inputs.depth, inputs.mask)[None, None],
        normal=normal.permute(2, 0, 1)[None],
        prior_confidence=torch.tensor([inputs.prior_confidence]),
    )


def relative_depth(depth: Float[Tensor, "h w"], mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Log of depth over the object's median, clamped to [-2, 2]; 2 where nothing is."""
    there = depth > 0
    inside = there & (mask > 0.5)
    known = depth[inside] if bool(inside.any()) else depth[there]
    middle = known.median() if known.numel() else depth.new_ones(())
    return torch.where(there, (depth.clamp_min(1e-6) / middle).log().clamp(-2, 2), 2.0)


def _compressed(linear: Tensor) -> Tensor:
    """Log light, about [-1, 1]: a stop is the same step everywhere."""
    return (linear + 1 / 64).log() / 2 + 1


def _harmonics(normal: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 9 h w"]:
    b, _, h, w = normal.shape
    flat = normal.permute(0, 2, 3, 1).reshape(-1, 3)
    return spherical_harmonics.basis(flat, 2).reshape(b, h, w, SH_COUNT).permute(0, 3, 1, 2)


def _affine(lit: Float[Tensor, "b 3 h w"], grid: Float[Tensor, "b 12 l p q"]) -> Float[Tensor, "b 3 h w"]:
    """The change that the grid makes to colours: cells by place and by brightness, interpolated."""
    b, _, h, w = lit.shape
    luma = lit.mean(1).clamp(0, 1) ** (1 / 2.2) * 2 - 1
    y = (torch.arange(h, device=lit.device) + 0.5) / h * 2 - 1
    x = (torch.arange(w, device=lit.device) + 0.5) / w * 2 - 1
    where = torch.stack([x.expand(b, h, w), y[:, None].expand(b, h, w), luma], -1)[:, None]
    sliced = F.grid_sample(grid, where, padding_mode="border", align_corners=False)[:, :, 0]
    rows = sliced.reshape(b, 3, 4, h, w)
    return (rows[:, :, :3] * lit[:, None]).sum(2) + rows[:, :, 3]
